"""What a study shows of itself: rows, tables, pictures, curves. Numpy only, so that messages can carry them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from nerf_core.lab.flatland.view import FlatView

Result = dict[str, Any]  # what a row measured, as JSON values


@dataclass(frozen=True)
class Row:
    """One thing that a study measures.

    key: names its files: lower-case letters, digits, hyphens; unique in the study.
    label: names it in tables.
    values: what makes it, as JSON values, such as {"method": "nerf", "seed": 1}.
    """

    key: str
    label: str
    values: dict[str, Any] = field(default_factory=dict)


class Look(NamedTuple):
    """A picture of the work under way: its name, (h, w, 3) uint8 sRGB, and a remark such as its PSNR."""

    name: str
    image: np.ndarray
    note: str = ""


class Curve(NamedTuple):
    """A curve of the work under way: its name, and x and y (N,)."""

    name: str
    x: np.ndarray
    y: np.ndarray


class Knob(NamedTuple):
    """A number that may be turned while a study runs: its name, its range, and its value at first.

    of_view: whether it only chooses what is shown, and leaves the results as they are.
    """

    name: str
    least: float
    most: float
    value: float
    of_view: bool = False


@dataclass(frozen=True)
class Advance:
    """How far a row is.

    fraction: of its work, in [0, 1].
    text: in words.
    looks, curves: what can be looked at by now; empty: as before.
    knobs: the values of the study's knobs that differ from what was turned, by name: those of a resumed row.
    flat: what a window shows of Flatland; None: as before.
    """

    fraction: float
    text: str = ""
    looks: tuple[Look, ...] = ()
    curves: tuple[Curve, ...] = ()
    knobs: dict[str, float] = field(default_factory=dict)
    flat: FlatView | None = None


@dataclass(frozen=True)
class Table:
    """A table of a report.

    title: above it.
    columns: their names.
    rows: a text for each column.
    notes: sentences under it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [f"## {self.title}", "", _line(self.columns), _line(["---"] * len(self.columns))]
        lines += [_line(row) for row in self.rows]
        return "\n".join([*lines, "", *self.notes]).rstrip() + "\n"

    def plain(self) -> str:
        """Return the table as aligned text."""
        lines = [self.columns, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.columns))]
        text = ["  ".join(cell.ljust(wide) for cell, wide in zip(line, widths, strict=True)).rstrip() for line in lines]
        return "\n".join([self.title, "", *text, "", *self.notes])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


@dataclass(frozen=True)
class Report:
    """What a study concludes.

    tables: in their order.
    figures: PNG files by name, without the suffix.
    """

    tables: tuple[Table, ...]
    figures: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class RowState:
    """How far a row is: its label, its state, and a remark."""

    label: str
    state: Literal["waiting", "running", "done", "failed"]
    text: str = ""


@dataclass(frozen=True)
class StudyState:
    """How far a study is.

    name: its name in `STUDIES`.
    folder: where its files are.
    state: "running", or how it ended.
    rows: all of them.
    fraction: of all rows, in [0, 1].
    text: what is being done.
    seconds_left: an estimate; None: unknown.
    looks, curves: of the row under way, or of the last one.
    tables: of the rows that are done.
    knobs: what may be turned.
    files: the report and the figures, once they are written.
    figures: the figures' pictures.
    flat: what a window shows of Flatland.
    """

    name: str
    folder: Path
    state: Literal["running", "done", "cancelled", "failed"] = "running"
    rows: tuple[RowState, ...] = ()
    fraction: float = 0.0
    text: str = ""
    seconds_left: float | None = None
    looks: tuple[Look, ...] = ()
    curves: tuple[Curve, ...] = ()
    tables: tuple[Table, ...] = ()
    knobs: tuple[Knob, ...] = ()
    files: tuple[Path, ...] = ()
    figures: tuple[Look, ...] = ()
    flat: FlatView | None = None
