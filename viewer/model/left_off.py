"""The autosaves that the window offers to continue from. A thread reads them, so that no frame waits for a disk."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import numpy as np

from nerf_core.common.language import phrases
from nerf_core.common.text import size
from nerf_core.live.messages import Notice
from nerf_core.training import autosaves
from nerf_core.training.autosaves import Autosave


class LeftOff:
    """The autosaves as they were when they were last read.

    wake: called from the thread whenever there is something new to show.
    entries: the newest first; None: they are being read for the first time.
    pictures: uint8 (h, w, 4) by the file's path, as far as they are read.
    """

    def __init__(self, wake: Callable[[], None] = lambda: None) -> None:
        self._wake = wake
        self.entries: tuple[Autosave, ...] | None = None
        self.pictures: dict[str, np.ndarray] = {}
        self._notices: deque[Notice] = deque()
        self._turn = threading.Lock()  # threads work one after the other
        self._news = threading.Event()

    def read(self) -> None:
        """Read them, in a thread."""
        self._do(self._read)

    def clear(self) -> None:
        """Delete the listed ones, in a thread, and read again what is there then."""
        entries = self.entries or ()

        def clear() -> None:
            deleted, reasons = autosaves.clear(entries)
            self._notices.extend(Notice("error", reason) for reason in reasons)
            if deleted:
                freed = size(sum(one.bytes for one in deleted))
                words = phrases(
                    "deleted {n} autosave, {freed}", "deleted {n} autosaves, {freed}", len(deleted), freed=freed
                )
                self._notices.append(Notice("info", words))
            self._read()

        self._do(clear)

    def notices(self) -> list[Notice]:
        """Return what happened since the last call."""
        found = []
        while self._notices:
            found.append(self._notices.popleft())
        return found

    def changed(self) -> bool:
        """Return whether something is new since the last call."""
        changed = self._news.is_set()
        self._news.clear()
        return changed

    def _do(self, work: Callable[[], None]) -> None:
        def in_turn() -> None:
            with self._turn:
                work()

        threading.Thread(target=in_turn, name="autosaves", daemon=True).start()

    def _read(self) -> None:
        self.entries = tuple(autosaves.autosaves())
        self._tell()
        for one in self.entries:
            name = str(one.file)
            if name not in self.pictures and (found := autosaves.picture(one.file)) is not None:
                self.pictures[name] = found
                self._tell()

    def _tell(self) -> None:
        self._news.set()
        self._wake()
