"""Handle Ctrl-C, SIGTERM and a closed terminal (SIGHUP).

The program ends at once where nothing can be lost, and after saving where something can.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

ECHO_SECONDS = 0.5  # nobody presses Ctrl-C twice so fast: one event sent two signals


class Interrupted(KeyboardInterrupt):
    """A signal ended the program.

    status: the exit status that shells expect: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


def _numbers() -> tuple[signal.Signals, ...]:
    """Return the signals that ask a program to end on this system: not all have a name on each."""
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # a closed console sends SIGBREAK on Windows
    return tuple(getattr(signal, name) for name in names if hasattr(signal, name))


class Signals:
    """While this context lasts, the signals that ask a program to end raise `Interrupted` in the main thread.

    A SIGHUP that is ignored when the context begins stays ignored, because `nohup` asks for that.

    After `be_polite()` the first signal is only stored in `received`, and the program looks there. A second signal
    raises, unless it comes together with the first: a closing terminal and a wrapper process may both send one.

    received: the first signal since `be_polite()`; None: there was none.
    polite: whether `be_polite()` was called: the program has work to save before it ends.
    """

    NUMBERS = _numbers()

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.received: int | None = None
        self._clock = clock
        self.polite = False
        self._received_at = 0.0
        self._before: dict[int, Any] = {}  # the handlers to go back to

    def __enter__(self) -> Signals:
        handlers = {number: signal.getsignal(number) for number in self.NUMBERS}
        self._before = {n: h for n, h in handlers.items() if not (n.name == "SIGHUP" and h is signal.SIG_IGN)}
        self._install()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def be_polite(self) -> None:
        self._install()  # again, because pycolmap installs its own SIGTERM handler when it is imported
        self.polite = True

    def check(self) -> None:
        """Raise `Interrupted` if a signal is stored. Call it where stopping leaves no work half done."""
        if self.received is not None:
            raise Interrupted(self.received)

    def _install(self) -> None:
        for number in self._before:
            signal.signal(number, self._handle)

    def _handle(self, number: int, _: FrameType | None) -> None:
        now = self._clock()
        if self.received is not None and now - self._received_at < ECHO_SECONDS:
            return
        if not self.polite or self.received is not None:
            raise Interrupted(number)
        self.received, self._received_at = number, now
