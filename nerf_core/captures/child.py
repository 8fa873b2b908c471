"""A program in a process of its own that tells line by line how far it is, with the memory that it takes."""

from __future__ import annotations

import os
import queue
import subprocess
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO

MOST_ERRORS = 65536  # bytes of standard error that are kept, the last ones
END_SECONDS = 5.0  # for the threads that read it, once it was killed


class Child:
    """A started program. Its input is a pipe that ends when this process does, however it ends.

    Threads read what it says, because a pipe cannot be waited for with a time limit on every system.
    """

    def __init__(self, command: Sequence[str]) -> None:
        # its own session: a Ctrl-C in the terminal is ours to handle
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._errors = b""
        work = ((self._listen, self._process.stdout), (self._keep, self._process.stderr))
        self._threads = [threading.Thread(target=do, args=(stream,), daemon=True) for do, stream in work]
        for thread in self._threads:
            thread.start()

    def _listen(self, stream: IO[bytes]) -> None:
        for line in stream:
            self._lines.put(line)
        self._lines.put(None)

    def _keep(self, stream: IO[bytes]) -> None:
        for line in stream:
            self._errors = (self._errors + line)[-MOST_ERRORS:]

    def line(self, seconds: float) -> bytes | None:
        """Return the next line that it says; b"" if there is none within `seconds`. None: it has ended."""
        try:
            return self._lines.get(timeout=seconds)
        except queue.Empty:
            return b""

    def fault(self) -> str:
        """Wait until it ends. Returns the last line of its errors, or "crash N"; empty: it succeeded."""
        status = self._process.wait()
        for thread in self._threads:
            thread.join(END_SECONDS)
        said = self._errors.decode("utf-8", "replace").strip().splitlines()
        return (said[-1] if status > 0 and said else f"crash {status}") if status else ""

    def memory(self) -> float:
        """Return its resident bytes; 0 where the system does not tell."""
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text("ascii").split()[1])
            return float(pages * os.sysconf("SC_PAGE_SIZE"))
        except (OSError, ValueError, IndexError):
            return 0.0

    def end(self) -> None:
        """Kill it if it still runs, and close its pipes."""
        self._process.kill()
        self._process.wait()
        for thread in self._threads:
            thread.join(END_SECONDS)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
