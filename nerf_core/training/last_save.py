"""Save a state where it can be saved: in the file that was asked for, else in the next place that takes it."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.training.checkpoint import SUFFIX, describe

MOST_NAME_BYTES = 100  # of a scene's name in a file's: systems take 255 bytes, and others are added


def autosave_folder() -> Path | None:
    """Return the folder for checkpoints that the user named no file for; None without platformdirs."""
    try:
        import platformdirs
    except ImportError:  # on a machine with only what training needs
        return None
    return Path(platformdirs.user_data_dir("nerf-viewer")) / "autosave"


def autosave_prefix(scene: Scene) -> str:
    """Return how the names of a scene's autosaves begin. It is at most MOST_NAME_BYTES + 9 bytes long."""
    name = re.sub(r"[^\w.-]+", "-", scene.name).strip(".-").encode(errors="replace")[:MOST_NAME_BYTES]
    return f"{name.decode(errors='ignore') or 'scene'}-{scene.identity()[:8]}"


def spare_files(scene: Scene) -> list[Path]:
    """Return new files for a scene's weights, the better ones first: among the user's data, and a temporary one."""
    name = f"{autosave_prefix(scene)}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}{SUFFIX}"
    folders = [autosave_folder(), Path(tempfile.gettempdir()) / "nerf-viewer"]
    return [folder / name for folder in folders if folder is not None]


def forget_old_autosaves(scene: Scene, count: int) -> None:
    """Delete all but the newest `count` autosaves of a scene. Files that are no checkpoints of it stay."""
    folder = autosave_folder()
    if folder is None:
        return
    own = [file for file in sorted(folder.glob(f"*{SUFFIX}"), key=_time) if _is_of(file, scene)]
    for file in own[: len(own) - count]:
        with suppress(OSError):
            file.unlink()


def _time(file: Path) -> float:
    with suppress(OSError):
        return file.stat().st_mtime
    return 0.0


def _is_of(file: Path, scene: Scene) -> bool:
    try:
        return scene.is_of(describe(file))
    except UserError:
        return False


def save_somewhere(files: Sequence[Path], write: Callable[[Path], None]) -> tuple[Path, tuple[str, ...]]:
    """Write to the first file that can be written.

    Args:
        files: where to write, the best place first.
        write: writes to a file; raises UserError if that fails, and then leaves nothing.

    Returns:
        The file, and why those before it could not be written.

    Raises:
        UserError: no file could be written; it names the reason of each.
    """
    reasons: list[str] = []
    for file in files:
        try:
            write(file)
        except UserError as error:
            reasons.append(str(error))
        else:
            return file, tuple(reasons)
    raise UserError("; ".join(reasons))
