"""Record how a ray changes over training: its weights over t, its colour, its depth and its opacity."""

from __future__ import annotations

import math

import numpy as np

from nerf_core.probe.records import RayHistory, RayProbe

BINS = 96  # bins over t in a record
RECORDS = 240  # records over a whole schedule, spaced evenly in log(step)


class HistoryRecorder:
    """Collects the records of one ray, at training steps that are spaced evenly in their logarithm."""

    def __init__(self, first: int, last: int) -> None:
        """Plan the steps at which records are due.

        Args:
            first: the training step at which the ray is watched first.
            last: the step at which the training schedule ends. Later records go on at the same rate.
        """
        span = max(last - first, 1)
        self._first, self._factor = first, math.expm1(math.log1p(max(last, RECORDS)) / RECORDS)
        self._due = first + log_spaced(span, RECORDS)
        self._next = 0  # the next of those steps, as an index
        self._edges: np.ndarray | None = None
        self._rows: list[tuple[int, np.ndarray, np.ndarray, float, float]] = []
        self._view: RayHistory | None = None

    @staticmethod
    def of(history: RayHistory, step: int, last: int) -> HistoryRecorder:
        """Continue a history, as after a checkpoint is loaded.

        Args:
            history: the records so far; those after `step` are dropped.
            step: the training step at which recording continues. A record is due there unless there is one.
            last: the step at which the training schedule ends.
        """
        recorder = HistoryRecorder(int(history.steps[0]), last)
        recorder._due = np.union1d(recorder._due, [step])
        recorder._edges = history.edges
        steps, depth, opacity = history.steps.tolist(), history.depth.tolist(), history.opacity.tolist()
        recorder._rows = list(zip(steps, history.weights, history.color, depth, opacity, strict=True))
        recorder.rewind(step)
        return recorder

    def due(self, step: int) -> bool:
        """Return whether a record is due at a training step."""
        if self._next == len(self._due):  # training continues past its schedule
            beyond = int(self._due[-1]) - self._first
            self._due = np.append(self._due, self._first + beyond + max(1, round(beyond * self._factor)))
        return step >= int(self._due[self._next])

    def add(self, ray: RayProbe) -> None:
        """Add a record of the ray; ask `due` before. It is ignored unless its step is later than the last record's."""
        if self._rows and ray.step <= self._rows[-1][0]:
            return
        if self._edges is None:
            self._edges = np.linspace(ray.near, max(ray.far, ray.near + 1e-6), BINS + 1)  # fixed: records are compared
        depth = np.nan if ray.depth_median is None else ray.depth_median
        self._rows.append((ray.step, binned(ray, self._edges), ray.color, depth, ray.opacity))
        self._view = None
        self._next = int(np.searchsorted(self._due, ray.step, "right"))

    def rewind(self, step: int) -> None:
        """Drop the records after `step`, because training went back to it. They become due again."""
        self._rows = [row for row in self._rows if row[0] <= step]
        self._next = int(np.searchsorted(self._due, self._rows[-1][0], "right")) if self._rows else 0
        self._view = None

    def view(self) -> RayHistory | None:
        """Return the records so far; None if there are none."""
        if self._view is None and self._rows and self._edges is not None:
            steps, weights, color, depth, opacity = zip(*self._rows, strict=True)
            self._view = RayHistory(
                self._edges, np.array(steps), np.stack(weights), np.stack(color), np.array(depth), np.array(opacity)
            )
        return self._view


def binned(ray: RayProbe, edges: np.ndarray) -> np.ndarray:
    """Return Σ w per bin of the pass that makes the pixel. A sample's weight is spread evenly over its stretch.

    Args:
        ray: an opened ray.
        edges: (B + 1,) the edges of the bins, as world distances along the ray.

    Returns:
        (B,) float32.
    """
    last = ray.passes[-1]
    if not len(last.t):
        return np.zeros(len(edges) - 1, np.float32)
    t = np.nan_to_num(last.t.astype(np.float64))
    until = np.clip(np.nan_to_num(last.until.astype(np.float64), nan=np.inf), t, np.append(t[1:], np.inf))
    until = np.where(np.isfinite(until) & (until < 1e9), until, t)  # endless: all its weight where it begins
    total = np.concatenate([[0], np.cumsum(np.nan_to_num(last.weights), dtype=np.float64)])
    knots = np.maximum.accumulate(np.stack([t, until], -1).ravel() + 1e-12 * np.arange(2 * len(t)))
    return np.diff(np.interp(edges, knots, np.stack([total[:-1], total[1:]], -1).ravel())).astype(np.float32)


def log_spaced(last: int, count: int) -> np.ndarray:
    """Return at least min(count, last + 1) different integers k from 0 to `last`, ascending.

    They are spaced evenly in log(1 + k), except where rounding to integers prevents this.
    """
    if last + 1 <= count:
        return np.arange(last + 1)
    more = count
    while True:
        found = np.unique(np.round(np.expm1(np.linspace(0, np.log1p(last), more))).astype(np.int64))
        if len(found) >= count:
            return found
        more = int(1.2 * more) + 1
