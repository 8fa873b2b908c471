"""Handle Ctrl-C and SIGTERM: end at once where nothing can be lost, and after saving where something can."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

ECHO_SECONDS = 0.5  # nobody presses Ctrl-C twice so fast: one event sent two signals


class Interrupted(KeyboardInterrupt):
    """A signal ended the program; `status` is the exit status that shells expect: 130 for Ctrl-C, 143 for SIGTERM."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


class Signals:
    """While this context lasts, SIGINT and SIGTERM raise `Interrupted` in the main thread.

    After `be_polite()` the first signal is only stored in `received`, and the program looks there. A second signal
    raises, unless it comes together with the first: a closing terminal and a wrapper process may both send one.
    """

    NUMBERS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.received: int | None = None
        self.handled_at = -math.inf  # the clock's time at which the main thread last noticed a signal
        self._clock = clock
        self._polite = False
        self._received_at = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        self._before = {number: signal.getsignal(number) for number in self.NUMBERS}
        self._install()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def be_polite(self) -> None:
        self._install()  # again, because pycolmap installs its own SIGTERM handler when it is imported
        self._polite = True

    def check(self) -> None:
        """Raise `Interrupted` if a signal is stored. Call it where stopping leaves no work half done."""
        if self.received is not None:
            raise Interrupted(self.received)

    def _install(self) -> None:
        for number in self.NUMBERS:
            signal.signal(number, self._handle)

    def _handle(self, number: int, _: FrameType | None) -> None:
        now = self.handled_at = self._clock()
        if self.received is not None and now - self._received_at < ECHO_SECONDS:
            return
        if not self._polite or self.received is not None:
            raise Interrupted(number)
        self.received, self._received_at = number, now
