"""Save a state where it can be saved: in the file that was asked for, else in the next place that takes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.common.text import duration

TELL_SECONDS, LONGEST_SECONDS = (
    2.0,
    60.0,
)  # between two lines about a save that takes long: they come less and less often


def save_somewhere(files: Sequence[Path], write: Callable[[Path], Path]) -> tuple[Path, tuple[str, ...]]:
    """Write to the first file that can be written.

    Args:
        files: where to write, the best place first.
        write: writes to a file, or to one beside it, and returns that; raises UserError or OSError if that fails, and
            then leaves nothing.

    Returns:
        The file that was written, and why those before it could not be.

    Raises:
        UserError: no file could be written; it names the reason of each.
    """
    reasons: list[str] = []
    for file in files:
        try:
            return write(file), tuple(reasons)
        except (UserError, OSError) as error:
            reasons.append(str(error))
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
