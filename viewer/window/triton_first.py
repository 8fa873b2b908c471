"""Load triton's library by itself where torch brings triton, apart from Mesa's."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType


class _Binder(MetaPathFinder):
    """Finds triton as Python does. Before triton itself runs, its library is loaded; not when somebody only looks."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname) if fullname == "triton" else None
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                _load(spec.submodule_search_locations or [])
                run(module)

            spec.loader.exec_module = exec_module
        return spec


def _load(folders: Sequence[str]) -> None:
    for folder in folders:
        for library in sorted(Path(folder, "_C").glob("libtriton*.so")):
            with suppress(OSError):  # triton itself says what is wrong with it
                ctypes.CDLL(str(library), mode=os.RTLD_LOCAL | os.RTLD_DEEPBIND)


def bind_triton() -> None:
    """See to it that triton's library will be bound to its own symbols. To be called before any GL context.

    Mesa's drivers make all symbols of their LLVM global, and triton exports its own LLVM under the same names. Loaded
    after a driver, triton would be bound to the driver's LLVM, and the process would die in the middle of training:
    torch.optim loads triton on first use. With RTLD_DEEPBIND, a library looks for symbols in itself first. What imports
    it later gets the library that is loaded already. It takes 65 MB of memory, so it is not loaded before it is needed:
    torch 2.14 looks whether triton is there as soon as it is imported.
    """
    if hasattr(os, "RTLD_DEEPBIND") and not any(isinstance(finder, _Binder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Binder())
