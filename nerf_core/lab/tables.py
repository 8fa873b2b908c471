"""Cells of tables, and means over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import mean, stdev

from nerf_core.common.language import phrase
from nerf_core.common.text import NOTHING
from nerf_core.lab.records import Result


def cell(value: float | None, decimals: int) -> str:
    """Return a number with fixed decimals; a dash for None."""
    return NOTHING if value is None else f"{value:.{decimals}f}"


def spread(values: Sequence[float | None], decimals: int) -> str:
    """Return the mean of several runs, with ± the standard deviation if there are more than one; a dash for none."""
    known = [value for value in values if value is not None]
    if not known:
        return NOTHING
    text = f"{mean(known):.{decimals}f}"
    return text if len(known) == 1 else f"{text} ± {stdev(known):.{decimals}f}"


def failures(results: Mapping[str, Result], labels: Mapping[str, str]) -> tuple[str, ...]:
    """Return a sentence for each row that failed."""
    return tuple(
        phrase("{row}: {reason}.", row=labels[key], reason=result["failed"])
        for key, result in results.items()
        if "failed" in result
    )


def numbers(results: Sequence[Result], name: str) -> list[float | None]:
    """Return a measured number of each result; None where it is missing."""
    return [result.get(name) for result in results]
