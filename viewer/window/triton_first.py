"""Load triton's library by itself where torch brings triton, apart from Mesa's."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType


class _Binder(MetaPathFinder):
    """Finds nothing. When triton is looked for, it loads triton's library."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if fullname != "triton":
            return
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec("triton")
        for folder in (spec.submodule_search_locations or []) if spec is not None else []:
            for library in sorted(Path(folder, "_C").glob("libtriton*.so")):
                with suppress(OSError):  # triton itself says what is wrong with it
                    ctypes.CDLL(str(library), mode=os.RTLD_LOCAL | os.RTLD_DEEPBIND)


def bind_triton() -> None:
    """See to it that triton's library will be bound to its own symbols. To be called before any GL context.

    Mesa's drivers make all symbols of their LLVM global, and triton exports its own LLVM under the same names. Loaded
    after a driver, triton would be bound to the driver's LLVM, and the process would die in the middle of training:
    torch.optim loads triton on first use. With RTLD_DEEPBIND, a library looks for symbols in itself first. What imports
    it later gets the library that is loaded already. It takes 65 MB of memory, so it is not loaded before it is needed.
    """
    if hasattr(os, "RTLD_DEEPBIND") and not any(isinstance(finder, _Binder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Binder())
