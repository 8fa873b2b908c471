"""Save a state where it can be saved: in the file that was asked for, else in the next place that takes it."""

from __future__ import annotations

import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.common.files import clear_leftovers
from nerf_core.common.text import duration
from nerf_core.geometry.scene import Scene
from nerf_core.training.checkpoint import SUFFIX, describe

MOST_NAME_BYTES = 100  # of a scene's name in a file's: systems take 255 bytes, and others are added
AUTOSAVE = re.compile(rf".+-[0-9a-f]{{8}}-\d{{8}}-\d{{6}}-\d+{re.escape(SUFFIX)}")  # a name that `spare_files` gives
TELL_SECONDS, LONGEST_SECONDS = (
    2.0,
    60.0,
)  # between two lines about a save that takes long: they come less and less often


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
    return [folder / name for folder in _spare_folders()]


def clear_spare_leftovers() -> None:
    """Delete what killed processes left half written in the folders of `spare_files`."""
    for folder in _spare_folders():
        clear_leftovers(folder)


def _spare_folders() -> list[Path]:
    folders = [autosave_folder()]
    with suppress(OSError):  # no folder for temporary files can be written
        # no folder of its own below it: the first user's could not be written by others
        folders.append(Path(tempfile.gettempdir()))
    return [folder for folder in folders if folder is not None]


def forget_old_autosaves(scene: Scene, count: int) -> None:
    """Delete all but the newest `count` autosaves of a scene.

    A file stays if it has another name than autosaves have, or is no checkpoint of the scene: it is the user's own.
    """
    folder = autosave_folder()
    if folder is None:
        return
    own = [file for file in sorted(folder.glob(f"*{SUFFIX}"), key=_time) if AUTOSAVE.fullmatch(file.name)]
    own = [file for file in own if _is_of(file, scene)]
    for file in own[: max(0, len(own) - count)]:
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


@contextmanager
def telling(step: int, say: Callable[[str], object], *, asked: bool) -> Iterator[None]:
    """Say every few seconds how long a save takes, from a thread of its own, until the block ends.

    Args:
        step: what is saved.
        say: takes a line.
        asked: whether a signal asked for the end, so that the next one ends the program without saving.
    """
    begin, done = time.monotonic(), threading.Event()

    def tell() -> None:
        pause = TELL_SECONDS
        while not done.wait(pause):
            pause = min(1.5 * pause, LONGEST_SECONDS)
            taken = duration(time.monotonic() - begin)
            say(f"saving step {step:,} takes {taken} so far; Ctrl-C{'' if asked else ' twice'} ends without saving")

    thread = threading.Thread(target=tell, name="telling", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
