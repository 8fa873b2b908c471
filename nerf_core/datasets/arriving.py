"""Read the photos of a large capture in threads, while those that are there are used already."""

from __future__ import annotations

import os
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.datasets.images import UnreadableError
from nerf_core.datasets.photo_store import FLUSH, Store
from nerf_core.geometry.photos import DAMAGED, THERE, WAITING, PhotosLost

NICENESS = 10  # of the threads: the window's goes first
NEW = 16  # photos read before the time for the rest is told


class Arriving:
    """Reads N photos in threads from `start` on, and at once where one is asked for; see `photos.Filling`.

    The threads end when nobody has this object any more. They know only `_Work`.

    Args:
        read: returns the pixels (n, 3) of photo k as they are stored. Raises UnreadableError for a damaged one.
        starts: (N,) the row of `store` at which each photo begins.
        order: see `photos.Filling`.
        sizes: (N,) the sizes of their files in bytes.
        store: takes the pixels.
    """

    def __init__(
        self, read: Callable[[int], np.ndarray], starts: np.ndarray, order: np.ndarray, sizes: np.ndarray, store: Store
    ) -> None:
        self._work = _Work(read, starts, order, store)
        self.order, self.state, self.bytes = order, self._work.state, sizes
        weakref.finalize(self, self._work.end).atexit = False  # the threads do not outlive the process

    def start(self, threads: int) -> None:
        """Begin to read in threads."""
        for _ in range(threads):
            threading.Thread(target=self._work.go_on, name="photos", daemon=True).start()

    def need(self, k: int) -> None:
        self._work.need(k)

    def prefer(self, k: int) -> None:
        self._work.preferred.append(k)

    def check(self) -> None:
        self._work.check()

    def seconds_left(self) -> float | None:
        return self._work.seconds_left()

    def damaged(self) -> tuple[str, ...]:
        return tuple(self._work.damaged)


class _Work:
    """What the threads share."""

    def __init__(self, read: Callable[[int], np.ndarray], starts: np.ndarray, order: np.ndarray, store: Store) -> None:
        self.state = np.where(store.there, THERE, WAITING).astype(np.uint8)
        self.preferred: deque[int] = deque(maxlen=FLUSH)  # what windows wait for; more than a screen shows is forgotten
        self.damaged: list[str] = []
        self._read, self._starts, self._store = read, starts, store
        self._queue = deque(order.tolist())
        self._reading: set[int] = set()
        self._unmarked: list[int] = []
        self._changed = threading.Condition()
        self._ended, self._failure = False, ""
        self._begun, self._new = 0.0, 0

    def end(self) -> None:
        """Let the threads end after the photo that each reads."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def check(self) -> None:
        """Raises PhotosLost if reading had to end."""
        if self._failure:
            raise PhotosLost(self._failure)

    def go_on(self) -> None:
        """Read photo after photo, in a thread."""
        if sys.platform == "linux":
            thread = threading.get_native_id()
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, max(NICENESS, os.getpriority(os.PRIO_PROCESS, thread)))
        while (k := self._next()) is not None:
            self._do(k)
        self._mark(1)

    def need(self, k: int) -> None:
        """Read photo k in this thread, or wait for the one that reads it. Raises PhotosLost if reading had to end."""
        if self.state[k] != WAITING:
            return
        with self._changed:
            while k in self._reading:
                self._changed.wait()
            self.check()
            if self.state[k] != WAITING:
                return
            self._reading.add(k)
        self._do(k)
        self.check()

    def seconds_left(self) -> float | None:
        with self._changed:
            if self._new < NEW:
                return None
            left = int((self.state == WAITING).sum())
            return left * (time.monotonic() - self._begun) / self._new

    def _next(self) -> int | None:
        """Claim the next photo; None: all are read, or nobody wants them."""
        with self._changed:
            while not self._ended and not self._failure and (self.preferred or self._queue):
                k = self.preferred.pop() if self.preferred else self._queue.popleft()
                if self.state[k] == WAITING and k not in self._reading:
                    self._reading.add(k)
                    return k
        return None

    def _do(self, k: int) -> None:
        """Read a photo that is claimed."""
        with self._changed:
            self._begun = self._begun or time.monotonic()
        state, problem = WAITING, ""
        try:
            self._store.write(int(self._starts[k]), self._read(k))
            state = THERE
        except UnreadableError as error:
            state, problem = DAMAGED, str(error)
        except OSError as error:
            self._fail(f"{error.filename or 'the cache of photos'}: {error.strerror or error}: check its rights and "
                       "the space on its disk")  # fmt: skip
        except UserError as error:
            self._fail(str(error))
        except BaseException as error:
            self._fail(f"reading photos failed: {type(error).__name__}: {error}")
            raise
        finally:
            self._end_of(k, state, problem)

    def _fail(self, text: str) -> None:
        self._failure = self._failure or text

    def _end_of(self, k: int, state: int, problem: str) -> None:
        with self._changed:
            self._reading.discard(k)
            self.state[k] = state
            self._new += state != WAITING
            if problem:
                self.damaged.append(problem)
            if state == THERE:
                self._unmarked.append(k)
            self._changed.notify_all()
        self._mark(FLUSH if (self.state == WAITING).any() else 1)

    def _mark(self, least: int) -> None:
        """Note in the cache which photos were read, if there are so many."""
        marked: list[int] = []
        with self._changed:
            if len(self._unmarked) >= least:
                marked, self._unmarked = self._unmarked, []
        if marked:
            try:
                self._store.mark(marked)  # without the lock: a flush may take a second
            except OSError as error:
                self._fail(f"the cache of photos cannot be written: {error.strerror or error}")
