"""Whether numba can be used, asked before anything imports it: where it keeps compiled loops is read only once."""

from __future__ import annotations

import hashlib
import os
import tempfile
from functools import lru_cache
from pathlib import Path


@lru_cache
def numba_obstacle() -> str:
    """Why numba cannot be used; empty where it can. Before importing it, says where compiled loops are kept."""
    if "NUMBA_CACHE_DIR" not in os.environ:
        os.environ["NUMBA_CACHE_DIR"] = str(_cache_folder())
    try:
        import numba  # noqa: F401
    except ImportError as error:
        return f"numba cannot be imported ({error})"
    return ""


def _cache_folder() -> Path:
    """The user's own; where that cannot be written, one for this process alone.

    Its name tells the loops' sources: numba compiles a function anew when its own file has changed, but not when
    another one has whose functions it inlines.
    """
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("numba_*.py")):
        digest.update(file.read_bytes())
    name = f"numba-{digest.hexdigest()[:12]}"
    try:
        import platformdirs

        folder = platformdirs.user_cache_path("nerf-viewer") / name
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except (ImportError, OSError):
        pass
    # what lies there is loaded as code: a name that others can guess could be filled by them
    return Path(tempfile.mkdtemp(prefix="nerf-viewer-"))
