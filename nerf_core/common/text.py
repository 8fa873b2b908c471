"""Format numbers, durations and rates as text: English phrases, which `tr` says in the window's language."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence

import numpy as np

from nerf_core.common.language import digits, marked, phrase

NOTHING = "–"  # shown if there is no number


def number(value: float | None, significant: int = 4) -> str:
    """Format with so many significant digits and a real minus sign; a dash for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return digits(f"{value or 0.0:.{significant}g}".replace("-", "−"))  # a zero has no sign


def closest(word: str, known: Iterable[str]) -> str:
    """Return the known word that a misspelt one is most like; empty if it is like none."""
    return next(iter(difflib.get_close_matches(word, tuple(known), 1)), "")


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return " (did you mean …?)" for a misspelt word, to be put behind it; empty if no known word is like it."""
    near = closest(word, known)
    return f" (did you mean {near}?)" if near else ""


def counted(count: int, noun: str) -> str:
    """Format a number with its noun, whose plural ends in s: "1 photo", "1,200 photos"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def decimal(value: float, decimals: int = 3) -> str:
    """Format with fixed decimals, space for the sign and a real minus sign; a value that rounds to zero has no sign."""
    if not math.isfinite(value):
        return NOTHING
    return digits(f"{round(float(value), decimals) or 0.0: .{decimals}f}".replace("-", "−"))


def vector(values: Sequence[float] | np.ndarray, decimals: int = 3) -> str:
    """Format with fixed decimals and space for the sign, so that columns of figures do not jump."""
    return digits(" ".join(decimal(v, decimals) for v in values))


def triple(rgb: np.ndarray) -> str:
    """Format a colour's three numbers."""
    return digits(vector(rgb).replace("  ", " ").strip())


def duration(seconds: float | None) -> str:
    """Format with two units at most: "0.4 s", "42 s", "1 min 10 s", "2 h 5 min"."""
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 1:
        return phrase("{seconds:.1f} s", seconds=max(seconds, 0))
    whole = round(seconds)
    if whole < 60:
        return phrase("{seconds} s", seconds=whole)
    if whole < 3600:
        return phrase("{minutes} min {seconds} s", minutes=whole // 60, seconds=whole % 60)
    return phrase("{hours:,} h {minutes} min", hours=whole // 3600, minutes=whole % 3600 // 60)


def rate(per_second: float) -> str:
    """Format with three significant digits: "640k", "1.25M"; a dash before the first measurement."""
    if not math.isfinite(per_second) or per_second <= 0:
        return NOTHING
    for size, text in ((1e9, marked("{n:.3g}G")), (1e6, marked("{n:.3g}M")), (1e3, marked("{n:.3g}k"))):
        if per_second >= size:
            return phrase(text, n=per_second / size)
    return digits(f"{per_second:.3g}")


def size(count: float) -> str:
    """Format a number of bytes with three significant digits: "512 MB", "1.2 GB". 1 MB is 10⁶ bytes."""
    for unit, text in ((1e9, marked("{n:g} GB")), (1e6, marked("{n:g} MB")), (1e3, marked("{n:g} kB"))):
        if count >= 0.9995 * unit:
            return phrase(text, n=float(f"{count / unit:.3g}"))
    return phrase("{n:.0f} B", n=count)
