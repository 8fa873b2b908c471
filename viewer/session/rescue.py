"""Save and end the process where the window's thread cannot: it lost its X server, or it hangs in a driver's call."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

from nerf_core.common.output import complain
from nerf_core.common.signals import Signals

STUCK_SECONDS = 3.0  # a thread that does not end its work so long after a signal hangs; it looks 50 times a second
CLOSE_SECONDS = 5.0  # a window closes in a few milliseconds
LOST = 1  # exit status after the connection to the screen was lost


class Rescue:
    """Ends the process for a thread of the window that cannot.

    Python runs signal handlers in the main thread only, and only between two of its own instructions. A main thread
    that waits for an X server that hangs never gets there. So a thread of its own reads the signals' numbers from the
    pipe that the interpreter fills at once.

    Args:
        save: saves what is not saved yet, from any thread.
    """

    def __init__(self, save: Callable[[], None]) -> None:
        self._save = save
        self._ending = threading.Lock()  # is never released: who holds it ends the process
        self._attending = False  # the main thread holds it
        self._ours, self._pythons = socket.socketpair()
        self._pythons.setblocking(False)
        self._before = signal.set_wakeup_fd(self._pythons.fileno(), warn_on_full_buffer=False)
        self._timer: threading.Timer | None = None
        self._thread = threading.Thread(target=self._watch, name="rescue", daemon=True)
        self._thread.start()

    def attend(self) -> None:
        """The main thread saves and ends now. If another thread does that already, this never returns."""
        if not self._attending:
            self._ending.acquire()
            self._attending = True

    def lost(self) -> NoReturn:
        """Save, and end the process: the connection to the screen is lost."""
        _tell("the connection to the screen was lost")
        if self._ending.acquire(blocking=False):  # else the main thread has saved, and is closing the window
            self._save_and_end(LOST)
        os._exit(LOST)

    def closing(self, status: int) -> None:
        """End the process with this status if it has not ended in CLOSE_SECONDS: the screen may hang."""
        self._timer = threading.Timer(CLOSE_SECONDS, os._exit, (status,))
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
        saving = False  # in another thread, so that a second signal is seen
        while numbers := self._ours.recv(16):
            asked = sorted(set(numbers) & set(map(int, Signals.NUMBERS)))
            if asked and saving:
                os._exit(128 + asked[0])
            if asked and not self._attended():
                self._forget_waiting()
                _tell("the window hangs: saving without it")
                threading.Thread(target=self._save_and_end, args=(128 + asked[0],), daemon=True).start()
                saving = True

    def _forget_waiting(self) -> None:
        """Drop the signals of the time in which nothing told that the first one was seen."""
        self._ours.setblocking(False)
        with suppress(BlockingIOError):
            while self._ours.recv(16):
                pass
        self._ours.setblocking(True)

    def _attended(self) -> bool:
        """Wait up to STUCK_SECONDS for the main thread to save and end. If it does not, take that over."""
        limit = time.monotonic() + STUCK_SECONDS
        while time.monotonic() < limit:
            if self._ending.locked():
                return True
            time.sleep(0.05)
        return not self._ending.acquire(blocking=False)

    def _save_and_end(self, status: int) -> NoReturn:
        try:
            self._save()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:  # whatever fails, there is nothing to go back to
            os._exit(status)


def _tell(text: str) -> None:
    complain(f"nerf-viewer: {text}")
