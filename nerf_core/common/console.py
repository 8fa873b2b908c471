"""Show progress: as a bar on a terminal, as an occasional line in a file or a pipe."""

from __future__ import annotations

import sys
import time
from types import TracebackType

from nerf_core.common.names import printable
from nerf_core.common.output import say
from nerf_core.common.text import duration

LINE_SECONDS, LINES_GROW, LONGEST_SECONDS = (
    5.0,
    1.3,
    60.0,
)  # lines come less and less often, because long work is looked at less often
FRAME_SECONDS = 0.1


class Display:
    """A context manager that shows the progress of one piece of work. On a terminal the bar disappears at the end."""

    def __init__(self, title: str) -> None:
        self._title = printable(title)
        self._bar = None
        self._every, self._shown = LINE_SECONDS, time.monotonic()
        if sys.stdout.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

            columns = (
                TextColumn("{task.description}", markup=False),  # names may have square brackets
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[text]}", markup=False),
            )
            # auto_refresh would start a thread that competes with training
            self._bar = Progress(*columns, console=Console(), auto_refresh=False, transient=True)
            self._task = self._bar.add_task(self._title, total=1.0, text="")
            self._every, self._shown = FRAME_SECONDS, float("-inf")

    def __enter__(self) -> Display:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, fraction: float | None, text: str, seconds_left: float | None = None) -> None:
        """Show that `fraction` of the work is done. Calls that come too soon after the last shown one do nothing.

        fraction: None: nobody knows, and the text says how far it is.
        """
        now = time.monotonic()
        if now - self._shown < self._every:
            return
        self._shown = now
        if seconds_left is not None:
            text += f", {duration(seconds_left)} left"
        if self._bar is None:
            self._every = min(self._every * LINES_GROW, LONGEST_SECONDS)
            say(f"{self._title}: {text}" if fraction is None else f"{self._title}: {fraction:.0%}, {text}")
        else:
            total = None if fraction is None else 1.0  # without one, the bar moves to and fro
            self._bar.update(self._task, completed=fraction or 0.0, total=total, text=printable(text))
            self._bar.refresh()
