"""How much memory programs can still take, and giving back what this one has freed."""

from __future__ import annotations

import ctypes
import math
from contextlib import suppress
from pathlib import Path


def free_memory() -> float:
    """Return the bytes of memory that programs can still take; infinity where the system does not tell."""
    try:
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        pass
    return math.inf


def give_back() -> None:
    """Return freed memory to the system where the C library would keep it, which is so with glibc.

    It keeps freed blocks of up to 32 MB for later use, which may never come: those of a fine grid's cells have 13.
    """
    with suppress(AttributeError, OSError, TypeError):  # another library, or a system without one of its own
        ctypes.CDLL(None).malloc_trim(0)
