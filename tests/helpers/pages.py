"""Load the whole files that docs/extending.md shows, as if they lay in their folders."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from nerf_core.common.registry import Registry

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
WHOLE_FILE = re.compile(r"^```python\n# (\S+\.py)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def files() -> dict[str, str]:
    """The text of each Python file of the page, by its path."""
    return dict(WHOLE_FILE.findall(PAGE.read_text(encoding="utf-8")))


def loader(patch: pytest.MonkeyPatch) -> Callable[[str, Registry[Any]], ModuleType]:
    """Return a function that loads one of the files. What the file registers is removed after the test."""

    def load(path: str, registry: Registry[Any]) -> ModuleType:
        registry.names()  # load what is registered without the file
        patch.setattr(registry, "_items", {**registry._items})
        name = path.removesuffix(".py").replace("/", ".")
        module = ModuleType(name)
        module.__package__, module.__file__ = name.rpartition(".")[0], f"{PAGE.name}: {path}"
        patch.setitem(sys.modules, name, module)
        exec(compile("\n" * _line(path) + files()[path], str(PAGE), "exec"), vars(module))
        return module

    return load


def _line(path: str) -> int:
    """Count the lines of the page before the file's first line, so that a traceback names the right line."""
    text = PAGE.read_text(encoding="utf-8")
    return text[: text.index(f"# {path}\n")].count("\n") + 1
