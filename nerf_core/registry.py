"""Definition is registration: a plugin is one new file in its folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from nerf_core.errors import UserError, shorten

T = TypeVar("T")
S = TypeVar("S")


class Registry(Generic[T]):
    """Named plugins of one kind, found by importing every module of `package` on first use.

    Names keep the alphabetical order of their files, so that lists in menus and errors are stable.
    """

    def __init__(self, kind: str, package: str) -> None:
        self.kind = kind
        self._package = package
        self._items: dict[str, T] = {}
        self._complete = False

    def register(self, name: str) -> Callable[[S], S]:
        """Decorator. It hands back exactly what it got; that this is a T, the contract tests of its kind show."""

        def keep(item: S) -> S:
            if name in self._items:
                raise ValueError(f"two {self.kind}s are called {name!r}")
            plugin: Any = item
            self._items[name] = plugin
            return item

        return keep

    def names(self) -> tuple[str, ...]:
        self._load()
        return tuple(self._items)

    def get(self, name: str) -> T:
        """The plugin called `name`. Raises UserError naming the choices."""
        self._load()
        if name not in self._items:
            raise UserError(f"unknown {self.kind} {shorten(name)}: choose one of {', '.join(self._items)}")
        return self._items[name]

    def name_of(self, item: T) -> str:
        """What a plugin is called; nothing if it is none of these."""
        self._load()
        return next((name for name, one in self._items.items() if one is item), "")

    def _load(self) -> None:
        if not self._complete:
            self._complete = True  # first, so that a plugin may ask for names while it is imported
            package = importlib.import_module(self._package)
            for module in sorted(m.name for m in pkgutil.iter_modules(package.__path__)):
                importlib.import_module(f"{self._package}.{module}")
