"""Messages between the worker thread and the window. Only `wait` and `let_paint` wait for the other side."""

from __future__ import annotations

import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping

from nerf_core.live.messages import FIRST_RUN, CancelLoading, Command, Notice, Quit, Snapshot, ViewRequest

SOON_SECONDS = 0.004  # a window that was woken begins its frame within one or two milliseconds, if it draws one at all
FRAME_SECONDS = 0.1  # longest wait for a frame: longer ones wait for something else than the processor


class Mailbox:
    """Carries messages both ways between two threads.

    To the worker go commands, in order, and the newest view request of each run. To the window go the newest snapshot
    of each run, and notices, in order.
    """

    def __init__(self, wake: Callable[[], None], share: float) -> None:
        """Begin without messages. The first run has an empty snapshot.

        Args:
            wake: called from the worker's thread whenever there is something new to show.
            share: the share of training that the empty snapshot states.
        """
        self._wake = wake
        self._numbers = itertools.count(1)
        self._commands: deque[tuple[int, Command]] = deque()
        self._views: dict[int, ViewRequest | None] = {}
        self._notices: queue.SimpleQueue[Notice] = queue.SimpleQueue()
        self._snapshots: Mapping[int, Snapshot] = {FIRST_RUN: Snapshot(wanted_share=share)}
        self._painted: deque[float] = deque(maxlen=1000)
        self._no_frame = threading.Event()  # set while the window draws none
        self._no_frame.set()
        self._frame = threading.Event()  # set while it draws one
        self._arrived = threading.Event()
        self._quit = threading.Event()
        self._loads_until = 0  # the newest command that ends the loading of commands before it

    # ---- the window's side ------------------------------------------------------------------------------------------

    def send(self, command: Command) -> int:
        """Queue a command.

        Returns:
            The command's number. Notices that answer it have it as `Notice.command`.
        """
        number = next(self._numbers)
        if isinstance(command, Quit | CancelLoading):
            self._loads_until = number
        self._commands.append((number, command))
        if isinstance(command, Quit):
            self._quit.set()
        self._arrived.set()
        return number

    def request_view(self, request: ViewRequest | None, run: int = FIRST_RUN) -> None:
        """Set what to draw of a run from now on.

        Args:
            request: the view; None draws nothing.
            run: the run's number if `request` is None; otherwise `request.run` counts.
        """
        self._views[run if request is None else request.run] = request
        self._arrived.set()

    def snapshot(self, run: int = FIRST_RUN) -> Snapshot:
        """Return the newest state of a run. Raises KeyError if the run does not exist."""
        return self._snapshots[run]

    def snapshots(self) -> Mapping[int, Snapshot]:
        """Return the newest state of every run, by number."""
        return self._snapshots

    def notices(self) -> list[Notice]:
        """Return the notices since this was last called, in order."""
        found = []
        while True:
            try:
                found.append(self._notices.get_nowait())
            except queue.Empty:
                return found

    def paints(self) -> None:
        """Note that the window begins to draw a frame."""
        self._no_frame.clear()
        self._frame.set()

    def painted(self, seconds: float) -> None:
        """Note that the window drew a frame in `seconds`. This time counts as pictures'."""
        self._painted.append(seconds)
        self._frame.clear()
        self._no_frame.set()

    @property
    def quitting(self) -> bool:
        """Whether Quit was sent. Commands before it are still done, but a scene that is loading is abandoned."""
        return self._quit.is_set()

    def must_not_load(self, command: int) -> bool:
        """Return whether what this command loads is no longer wanted: Quit or CancelLoading was sent after it."""
        return self._loads_until > command

    # ---- the worker's side ------------------------------------------------------------------------------------------

    def next_command(self) -> tuple[int, Command] | None:
        """Return the next command with its number, and leave it in the queue; None if there is none."""
        return self._commands[0] if self._commands else None

    def take(self) -> tuple[int, Command]:
        """Remove the next command from the queue, and return it with its number."""
        return self._commands.popleft()

    def view(self, run: int) -> ViewRequest | None:
        """Return what to draw of a run; None for nothing."""
        return self._views.get(run)

    def let_paint(self, soon: bool = False) -> None:
        """Wait while the window draws a frame. One that takes longer than FRAME_SECONDS is not waited for again.

        soon: whether it is probably about to begin one, because it was woken for something that it shows at once.
        """
        if soon:
            self._frame.wait(SOON_SECONDS)
        if not self._no_frame.wait(FRAME_SECONDS):
            self._frame.clear()
            self._no_frame.set()

    def paint_seconds(self) -> float:
        """Return the seconds of the window's frames since this was last called."""
        total = 0.0
        while self._painted:
            total += self._painted.popleft()
        return total

    def deliver(self, snapshots: Mapping[int, Snapshot]) -> None:
        """Publish the state of every run, by number. Runs that are not in it no longer exist."""
        self._snapshots = snapshots

    def tell(self, notice: Notice) -> None:
        """Send a notice to the window."""
        self._notices.put(notice)

    def wake(self) -> None:
        """Tell the window that there is something new to show."""
        self._wake()

    def begin_turn(self) -> None:
        """Begin a turn of the worker: `wait` returns at once if anything arrives after this call."""
        self._arrived.clear()

    def wait(self, seconds: float) -> None:
        """Wait until something arrives, at most `seconds`."""
        self._arrived.wait(seconds)
