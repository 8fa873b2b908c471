"""Keep Python's garbage collector away while large libraries are imported."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def imports() -> Iterator[None]:
    """Import large libraries without collecting garbage, and exempt what they made from later collections.

    torch and numba make half a million objects that live as long as the process. The collector would look at all of
    them several times while they are made, which takes a tenth of the time of the import, and again whenever it looks
    at everything, while a window waits. Whoever has disabled the collector keeps it disabled.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
