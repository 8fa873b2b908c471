"""Load triton's library before Mesa's, where torch brings triton."""

from __future__ import annotations

import ctypes
from importlib.util import find_spec
from pathlib import Path


def bind_triton() -> None:
    """Load triton's library, if there is one, and so bind its symbols to itself. To be called before any GL context.

    Mesa's drivers make all symbols of their LLVM global, and triton exports its own LLVM under the same names. Loaded
    after a driver, triton would be bound to the driver's LLVM, and the process would die in the middle of training:
    torch.optim loads triton on first use. Loaded before, its library is bound, and nothing that comes later changes
    that. It takes 30 ms, and `import triton` with torch._dynamo, which imports it for torch, more than a second.
    """
    spec = find_spec("triton")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        for library in sorted(Path(folder, "_C").glob("libtriton*.so")):
            ctypes.CDLL(str(library))
