"""Save and end the process where the window's thread cannot: it lost its X server, or it hangs in a driver's call."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from nerf_core.common.signals import Signals

STUCK_SECONDS = 2.0  # a thread that has not handled a signal for so long hangs; frames take a twentieth of it
CLOSE_SECONDS = 5.0  # a window closes in a few milliseconds
LOST = 1  # exit status after the connection to the screen was lost


class Rescue:
    """Ends the process for a thread of the window that cannot.

    Python runs signal handlers in the main thread only, and only between two of its own instructions. A main thread
    that waits for an X server that hangs never gets there. So a thread of its own reads the signals' numbers from the
    pipe that the interpreter fills at once.

    Args:
        save: saves what is not saved yet, from any thread.
        signals: tells whether the main thread handled a signal.
        clock: seconds.
    """

    def __init__(self, save: Callable[[], None], signals: Signals, clock: Callable[[], float] = time.monotonic) -> None:
        self._save = save
        self._signals = signals
        self._clock = clock
        self._ours, self._pythons = socket.socketpair()
        self._pythons.setblocking(False)
        self._before = signal.set_wakeup_fd(self._pythons.fileno(), warn_on_full_buffer=False)
        self._timer: threading.Timer | None = None
        self._thread = threading.Thread(target=self._watch, name="rescue", daemon=True)
        self._thread.start()

    def lost(self) -> NoReturn:
        """Save, and end the process: the connection to the screen is lost."""
        _tell("the connection to the screen was lost")
        self._end(LOST)

    def closing(self, status: int) -> None:
        """End the process with this status if it has not ended in CLOSE_SECONDS: the screen may hang."""
        self._timer = threading.Timer(CLOSE_SECONDS, self._end, (status,))
        self._timer.daemon = True
        self._timer.start()

    def close(self) -> None:
        """Stop watching."""
        signal.set_wakeup_fd(self._before)
        self._pythons.close()  # ends the thread
        self._thread.join()
        self._ours.close()
        if self._timer is not None:
            self._timer.cancel()

    def _watch(self) -> None:
        while numbers := self._ours.recv(16):
            came = self._clock()
            for number in set(numbers) & set(map(int, Signals.NUMBERS)):
                time.sleep(STUCK_SECONDS)
                if (
                    self._signals.handled_at < came - STUCK_SECONDS / 2
                ):  # a signal may be handled before it is read here
                    _tell("the window hangs")
                    self._end(128 + number)

    def _end(self, status: int) -> NoReturn:
        try:
            self._save()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:  # whatever fails, there is nothing to go back to
            os._exit(status)


def _tell(text: str) -> None:
    print(f"nerf-viewer: {text}", file=sys.stderr)
