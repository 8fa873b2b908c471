"""Compile loops in a process of its own: what the compiler took is given back, and this process's threads go on."""

from __future__ import annotations

import hashlib
import platform
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

from nerf_core.common import collector
from nerf_core.common.jit.cache import PACKAGE, cache_folder, sources_digest

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
    mark = Path(folder) / f"{call_each.__module__}-{_key()}.compiled"
    code = CHILD.format(path=sys.path, folder=folder, module=call_each.__module__, name=call_each.__name__)
    try:
        if not mark.exists() and sys.executable and not getattr(sys, "frozen", False):
            # in a session of its own: a Ctrl-C in the terminal is for this process, which would else compile as well
            subprocess.run(
                [sys.executable, "-P", "-c", code], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, timeout=SECONDS, check=True, start_new_session=True,
            )  # fmt: skip
            mark.touch()
    except (OSError, subprocess.SubprocessError):
        pass  # then the loops are compiled here, below
    with collector.paused():  # numba imports its other half for the first loop
        call_each()


def _key() -> str:
    """What numba's index asks for: the files, versions of Python, numba and LLVM, and the processor."""
    import llvmlite
    import numba
    from llvmlite import binding
    from numba.core import config

    processor = (
        getattr(config, "CPU_NAME", None) or binding.get_host_cpu_name(),
        getattr(config, "CPU_FEATURES", None) or binding.get_host_cpu_features().flatten(),
    )
    parts = (sources_digest(), PACKAGE, platform.python_version(), numba.__version__, llvmlite.__version__, *processor)
    return hashlib.sha256("\n".join(map(str, parts)).encode("utf-8", "surrogateescape")).hexdigest()[:12]
