"""Find out whether numba can be used, and where it keeps compiled loops."""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from nerf_core.common import collector

PACKAGE = Path(__file__).parents[2]
IMPORTS_JIT = b"common.jit.vectors import"  # in every file that compiles loops
ALSO_COMPILED = ("common/jit/vectors.py", "geometry/lens.py")  # by such a file, or themselves
KEPT_SECONDS = 30 * 24 * 3600.0  # since a version last used its loops


@lru_cache
def numba_obstacle() -> str:
    """Return why numba cannot be used; empty if it can."""
    try:
        with collector.paused():
            import numba  # noqa: F401
    except ImportError as error:
        return f"numba cannot be imported ({error})"
    return ""


def sources() -> list[Path]:
    """Return every file with compiled loops."""
    importing = [file for file in PACKAGE.rglob("*.py") if IMPORTS_JIT in file.read_bytes()]
    return sorted({*importing, *(PACKAGE / name for name in ALSO_COMPILED)})


@lru_cache
def sources_digest() -> str:
    """Return 12 characters that change with the sources."""
    digest = hashlib.sha256()
    for file in sources():
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


@lru_cache
def cache_folder() -> str:
    """Return the folder of compiled loops: NUMBA_CACHE_DIR, or one in the user's cache."""
    return os.environ.get("NUMBA_CACHE_DIR") or str(_own_folder())


def _own_folder() -> Path:
    """A folder in the user's cache; if that cannot be written, a temporary one for this process.

    The folder's name contains a hash of all sources. numba recompiles a function when its own file changes, but not
    when a file changes whose functions it inlines.
    """
    name = f"numba-{sources_digest()}"
    try:
        import platformdirs

        folder = platformdirs.user_cache_path("nerf-viewer") / name
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.utime(folder)
            _forget_unused(folder.parent)
            return folder
    except (ImportError, OSError):
        pass
    # its files are loaded as code, so that nobody else may be able to guess the name and put files there first
    folder = Path(tempfile.mkdtemp(prefix="nerf-viewer-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _forget_unused(caches: Path) -> None:
    """Delete the loops of versions that nobody has run for KEPT_SECONDS."""
    for folder in caches.glob("numba-*"):
        with suppress(FileNotFoundError):  # another process may delete it at the same time
            if folder.stat().st_mtime < time.time() - KEPT_SECONDS:
                shutil.rmtree(folder, ignore_errors=True)
