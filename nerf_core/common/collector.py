"""Keep Python's garbage collector away while large libraries are imported."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class _Collector:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pauses = 0  # that are under way, in all threads
        self._enabled = False  # whether the collector was when the first of them began

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Collect no garbage meanwhile, in any thread. Afterwards the collector is enabled if it was before.

        torch and numba make some 0.3 million objects while they are imported. The collector would look at all of them
        several times, which takes a tenth to a seventh of the time.
        """
        with self._lock:
            if not self._pauses:
                self._enabled = gc.isenabled()
                gc.disable()
            self._pauses += 1
        try:
            yield
        finally:
            with self._lock:
                self._pauses -= 1
                if not self._pauses and self._enabled:
                    gc.enable()


paused = _Collector().paused
