"""Print what can be printed. An output that cannot be written ends no work."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from nerf_core.common.names import printable


class Forgiving:
    """A text stream over another one. It goes silent at the first error of the system: a full disk, a closed pipe.

    Characters that the stream cannot encode are written as escapes.

    error: the error; None: everything was written so far.
    """

    def __init__(self, stream: TextIO) -> None:
        self.error: OSError | None = None
        self._stream = stream
        with suppress(AttributeError, OSError):  # a stream in memory cannot be reconfigured and needs no such help
            cast(Any, stream).reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        if self.error is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._silence(error)
            except UnicodeEncodeError:  # a stream that could not be reconfigured
                self._stream.write(text.encode(errors="backslashreplace").decode())
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        if self.error is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._silence(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _silence(self, error: OSError) -> None:
        """Remember the error and send the rest to nowhere.

        That includes what the stream still holds in its buffer, which the interpreter would try to write at its end.
        """
        self.error = error
        with suppress(OSError, ValueError, AttributeError):
            number = self._stream.fileno()
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)


def say(text: str) -> None:
    """Print a line on standard output, whatever names it holds."""
    print(printable(text), flush=True)


def complain(text: str) -> None:
    """Print a line on standard error, whatever names it holds."""
    print(printable(text), file=sys.stderr, flush=True)


@contextmanager
def forgiving_output(silent: bool = False) -> Iterator[Forgiving]:
    """Make `sys.stdout` and `sys.stderr` forgiving during the block. Yields the former.

    silent: print nothing.
    """
    before = sys.stdout, sys.stderr
    streams = (None, None) if silent else before
    out, err = (Forgiving(stream or open(os.devnull, "w")) for stream in streams)  # noqa: SIM115  None: no console
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def unprinted(output: Forgiving) -> str:
    """Return why the output is incomplete; "" if it is whole, or if its reader closed it and wants no more."""
    output.flush()
    error = output.error
    if error is None or error.errno == errno.EPIPE:
        return ""
    return f"the output is incomplete: {error.strerror or error}: send it where there is space"
