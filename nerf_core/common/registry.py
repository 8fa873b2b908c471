"""Registration by definition: a plug-in is one new file in its folder, or an entry point of an installed package."""

from __future__ import annotations

import importlib
import logging
import pkgutil
import threading
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any, Generic, TypeVar

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.text import suggestion

T = TypeVar("T")
S = TypeVar("S")

_LOADING = threading.RLock()  # one for all registries: with one each, two threads could wait for each other's imports


class Registry(Generic[T]):
    """Named plug-ins of one kind. They are found on first use, not on import. Threads may share it.

    kind: what one of them is called in messages ("method").
    package: every module of this package is imported. A sub-package counts as a plug-in if it has a module `leaf`.
    leaf: the module of a sub-package that registers, such as nerf_core/methods/hash/method.py; empty: none does.
    entry_points: the group of Python entry points that packages outside this repository use. Each names a module
        whose import registers. Empty: the kind is not open to other packages.
    """

    def __init__(self, kind: str, package: str, *, leaf: str = "", entry_points: str = "") -> None:
        self.kind = kind
        self.problems: list[str] = []
        self._package, self._leaf, self._group = package, leaf, entry_points
        self._items: dict[str, T] = {}
        self._complete = self._loading = False

    def register(self, name: str) -> Callable[[S], S]:
        """Decorator that adds a plug-in under `name` and returns it unchanged.

        Raises ValueError for a name that is taken. The contract tests of a kind check that a plug-in is a T.
        """

        def keep(item: S) -> S:
            if name in self._items:
                raise ValueError(f"two {self.kind}s are called {name!r}")
            plugin: Any = item
            self._items[name] = plugin
            return item

        return keep

    def names(self) -> tuple[str, ...]:
        """All names in alphabetical order: the same whichever module was imported first."""
        self._load()
        return tuple(sorted(self._items))

    def get(self, name: str) -> T:
        """The plug-in called `name`. Raises UserError that lists the choices."""
        self._load()
        if name not in self._items:
            near = suggestion(name, self.names())
            raise UserError(f"unknown {self.kind} {shorten(name)}{near}: choose one of {', '.join(self.names())}")
        return self._items[name]

    def name_of(self, item: T) -> str:
        """The name of a plug-in; empty if it is not registered."""
        self._load()
        return next((name for name, one in self._items.items() if one is item), "")

    def _load(self) -> None:
        if self._complete:
            return
        with _LOADING:
            if self._complete or self._loading:  # a plug-in may ask for names while it is imported
                return
            self._loading = True
            try:
                self._import_all()
                self._complete = True  # after all imports, so that an ImportError is raised at every use
            finally:
                self._loading = False

    def _import_all(self) -> None:
        package = importlib.import_module(self._package)
        for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
            name = f"{self._package}.{module.name}"
            if not module.ispkg:
                importlib.import_module(name)
            elif self._leaf and find_spec(f"{name}.{self._leaf}") is not None:
                importlib.import_module(f"{name}.{self._leaf}")
        for point in sorted(entry_points(group=self._group), key=lambda p: p.name) if self._group else ():
            try:
                point.load()
            except Exception as error:  # another package's fault must not take this program down; it is told
                problem = (
                    f"the {self.kind} {point.name} of package {point.dist.name if point.dist else '?'} cannot be "
                    f"loaded ({type(error).__name__}: {error}): update or uninstall that package"
                )
                self.problems.append(problem)
                logging.getLogger("nerf_viewer").warning(problem)  # by default on standard error, once
