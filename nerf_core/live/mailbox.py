"""What passes between the worker thread and whoever started it; no method here ever waits for the other side."""

from __future__ import annotations

import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping

from nerf_core.live.messages import FIRST_RUN, Command, Notice, Quit, Snapshot, ViewRequest


class Mailbox:
    """In go commands in order, and the newest view of each run. Out come its newest snapshot, and notices in order.

    wake: called from the worker's thread whenever there is something new to show.
    """

    def __init__(self, wake: Callable[[], None], share: float) -> None:
        self._wake = wake
        self._numbers = itertools.count(1)
        self._commands: deque[tuple[int, Command]] = deque()
        self._views: dict[int, ViewRequest | None] = {}
        self._notices: queue.SimpleQueue[Notice] = queue.SimpleQueue()
        self._snapshots: Mapping[int, Snapshot] = {FIRST_RUN: Snapshot(wanted_share=share)}
        self._painted: deque[float] = deque(maxlen=1000)
        self._arrived = threading.Event()
        self._quit = threading.Event()

    # ---- the window's side ------------------------------------------------------------------------------------------

    def send(self, command: Command) -> int:
        """Queue a command; the number that notices which answer it carry as `Notice.command`."""
        number = next(self._numbers)
        self._commands.append((number, command))
        if isinstance(command, Quit):
            self._quit.set()
        self._arrived.set()
        return number

    def request_view(self, request: ViewRequest | None, run: int = FIRST_RUN) -> None:
        """What to draw of a run from now on; None: nothing."""
        self._views[run if request is None else request.run] = request
        self._arrived.set()

    def snapshot(self, run: int = FIRST_RUN) -> Snapshot:
        """The newest state of a run. Raises KeyError for one that does not exist."""
        return self._snapshots[run]

    def snapshots(self) -> Mapping[int, Snapshot]:
        """The newest state of every run, by its number."""
        return self._snapshots

    def notices(self) -> list[Notice]:
        """What happened since this was last called, in order."""
        found = []
        while True:
            try:
                found.append(self._notices.get_nowait())
            except queue.Empty:
                return found

    def painted(self, seconds: float) -> None:
        """The window drew a frame in so many seconds: they are part of what pictures take."""
        self._painted.append(seconds)

    @property
    def quitting(self) -> bool:
        """Whether Quit was sent; what was sent before it is still done."""
        return self._quit.is_set()

    # ---- the worker's side ------------------------------------------------------------------------------------------

    def next_command(self) -> tuple[int, Command] | None:
        """The command that is next in order, left in the queue."""
        return self._commands[0] if self._commands else None

    def take(self) -> tuple[int, Command]:
        return self._commands.popleft()

    def view(self, run: int) -> ViewRequest | None:
        return self._views.get(run)

    def paint_seconds(self) -> float:
        """Seconds of the window's frames since this was last called."""
        total = 0.0
        while self._painted:
            total += self._painted.popleft()
        return total

    def deliver(self, snapshots: Mapping[int, Snapshot]) -> None:
        self._snapshots = snapshots

    def tell(self, notice: Notice) -> None:
        self._notices.put(notice)

    def wake(self) -> None:
        self._wake()

    def begin_turn(self) -> None:
        """From here on `wait` returns at once if anything arrives."""
        self._arrived.clear()

    def wait(self, seconds: float) -> None:
        self._arrived.wait(seconds)
