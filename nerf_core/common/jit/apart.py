"""Compile loops in a process of its own: what the compiler took is given back, and this process's threads go on."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

from nerf_core.common.jit.cache import cache_folder
from nerf_core.common.subprograms import run_limited

SECONDS = 600.0  # ten seconds on a laptop; after this, a machine is so busy that it makes no difference who compiles
CHILD = """
import os, sys
sys.path[:] = {path!a}
os.environ["NUMBA_CACHE_DIR"] = {folder!a}
from {module} import {name}
{name}()
"""


@cache
def compile_loops(call_each: Callable[[], None]) -> None:
    """Compile loops, so that no step has to wait for it later; read them from numba's cache if it has them.

    Where this process compiles, it keeps some hundred megabytes of the compiler's, and its other threads wait for
    Python's lock. So another process fills the cache first. If it fails, this one compiles.

    Args:
        call_each: a function at the top of a module that calls each of the loops once, with all types of arguments that
            are used.
    """
    folder = cache_folder()
    mark = Path(folder) / f"{call_each.__module__}-{_compiler()}.compiled"
    if sys.executable and not mark.exists():
        code = CHILD.format(path=sys.path, folder=folder, module=call_each.__module__, name=call_each.__name__)
        try:
            if not run_limited([sys.executable, "-P", "-c", code], SECONDS).reason:
                mark.touch()
        except (OSError, subprocess.TimeoutExpired):
            pass  # then the loops are compiled here, below
    call_each()


def _compiler() -> str:
    """What numba's own index asks for, besides the source: other versions and processors have loops of their own."""
    import llvmlite
    import numba
    from numba.core import config

    processor = getattr(config, "CPU_NAME", None) or llvmlite.binding.get_host_cpu_name()
    return "-".join((platform.python_version(), numba.__version__, llvmlite.__version__, processor))
