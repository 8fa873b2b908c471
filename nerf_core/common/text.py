"""Format numbers, durations and rates as text."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

NOTHING = "–"  # shown if there is no number


def number(value: float | None, digits: int = 4) -> str:
    """Format with `digits` significant digits and a real minus sign; a dash for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value or 0.0:.{digits}g}".replace("-", "−")  # a zero has no sign


def counted(count: int, noun: str) -> str:
    """Format a number with its noun, whose plural ends in s: "1 photo", "1,200 photos"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def decimal(value: float, decimals: int = 3) -> str:
    """Format with fixed decimals, space for the sign and a real minus sign; a value that rounds to zero has no sign."""
    if not math.isfinite(value):
        return NOTHING
    return f"{round(float(value), decimals) or 0.0: .{decimals}f}".replace("-", "−")


def vector(values: Sequence[float] | np.ndarray, decimals: int = 3) -> str:
    """Format with fixed decimals and space for the sign, so that columns of figures do not jump."""
    return " ".join(decimal(v, decimals) for v in values)


def triple(rgb: np.ndarray) -> str:
    """Format a colour's three numbers."""
    return vector(rgb).replace("  ", " ").strip()


def duration(seconds: float | None) -> str:
    """Format with two units at most: "0.4 s", "42 s", "1 min 10 s", "2 h 5 min"."""
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 1:
        return f"{max(seconds, 0):.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600:,} h {whole % 3600 // 60} min"


def rate(per_second: float) -> str:
    """Format with three significant digits: "640k", "1.25M"; a dash before the first measurement."""
    if not math.isfinite(per_second) or per_second <= 0:
        return NOTHING
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if per_second >= size:
            return f"{per_second / size:.3g}{letter}"
    return f"{per_second:.3g}"


def size(count: float) -> str:
    """Format a number of bytes with three significant digits: "512 MB", "1.2 GB". 1 MB is 10⁶ bytes."""
    for unit, letter in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= 0.9995 * unit:
            return f"{float(f'{count / unit:.3g}'):g} {letter}"
    return f"{count:.0f} B"
