"""Whether numba can be used, and where it keeps compiled loops."""

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

PACKAGE = Path(__file__).parents[2]
# Every file with compiled loops, relative to the package. A test compares this list with the files that use @jit.
SOURCES = (
    "common/jit/vectors.py",
    "geometry/lens.py",
    "geometry/numba_rays.py",
    "kernels/numba_march.py",
    "kernels/numba_packed.py",
    "kernels/numba_voxels.py",
)
KEPT_SECONDS = 30 * 24 * 3600.0  # since a version last used its loops


@lru_cache
def numba_obstacle() -> str:
    """Why numba cannot be used; empty where it can."""
    try:
        import numba  # noqa: F401
    except ImportError as error:
        return f"numba cannot be imported ({error})"
    return ""


@lru_cache
def cache_folder() -> str:
    """Where compiled loops are kept: NUMBA_CACHE_DIR, or a folder of ours."""
    return os.environ.get("NUMBA_CACHE_DIR") or str(_own_folder())


def _own_folder() -> Path:
    """The user's own; where that cannot be written, one for this process alone.

    Its name tells the loops' sources: numba compiles a function anew when its own file has changed, but not when
    another one has whose functions it inlines.
    """
    digest = hashlib.sha256()
    for file in SOURCES:
        digest.update((PACKAGE / file).read_bytes())
    name = f"numba-{digest.hexdigest()[:12]}"
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
    # what lies there is loaded as code: a name that others can guess could be filled by them
    folder = Path(tempfile.mkdtemp(prefix="nerf-viewer-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _forget_unused(caches: Path) -> None:
    """Delete the loops of versions that nobody has run for long."""
    for folder in caches.glob("numba-*"):
        with suppress(FileNotFoundError):  # another process deletes it too
            if folder.stat().st_mtime < time.time() - KEPT_SECONDS:
                shutil.rmtree(folder, ignore_errors=True)
