"""Record how a ray changes over training: its weights over t, its colour, its depth and its opacity."""

from __future__ import annotations

import numpy as np

from nerf_core.probe.records import RayHistory, RayProbe

BINS = 96  # bins over t in a record
# A record follows another after 1 / SHARE of the steps since the first. So they are even in log(step), without a look
# at how long the schedule is: every step up to 100, over 200 by step 1,000, and some 400 by step 30,000.
SHARE = 50


class HistoryRecorder:
    """Collects the records of one ray, at training steps that are spaced evenly in their logarithm; see SHARE."""

    def __init__(self, first: int, last: int) -> None:
        """Begin without records.

        Args:
            first: the training step at which the ray is watched first.
            last: the step at which the training schedule ends: a record is due there, too.
        """
        self._first, self._asked = first, {last}  # the latter: steps besides the regular ones
        self._due = first  # the step at which the next record is due
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
        recorder._asked.add(step)
        recorder._edges = history.edges
        steps, depth, opacity = history.steps.tolist(), history.depth.tolist(), history.opacity.tolist()
        recorder._rows = list(zip(steps, history.weights, history.color, depth, opacity, strict=True))
        recorder.rewind(step)
        return recorder

    def due(self, step: int) -> bool:
        """Return whether a record is due at a training step."""
        return step >= self._due

    def add(self, ray: RayProbe) -> None:
        """Add a record of the ray; ask `due` before. It is ignored unless its step is later than the last record's."""
        if self._rows and ray.step <= self._rows[-1][0]:
            return
        if self._edges is None:
            self._edges = np.linspace(ray.near, max(ray.far, ray.near + 1e-6), BINS + 1)  # fixed: records are compared
        known = ray.depth_median if ray.passes else ray.depth_expected
        depth = np.nan if known is None else known
        self._rows.append((ray.step, binned(ray, self._edges), ray.color, depth, ray.opacity))
        self._view = None
        self._due = self._after(ray.step)

    def rewind(self, step: int) -> None:
        """Drop the records after `step`, because training went back to it. They become due again."""
        self._rows = [row for row in self._rows if row[0] <= step]
        self._due = self._after(self._rows[-1][0]) if self._rows else self._first
        self._view = None

    def _after(self, step: int) -> int:
        """Return the first step after `step` at which a record is due. The regular ones do not depend on the others."""
        due = self._first
        while due <= step:
            due += max(1, (due - self._first) // SHARE)
        return min([due, *(asked for asked in self._asked if asked > step)])

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
        (B,) float32; NaN of a ray without samples, which has no weights.
    """
    if not ray.passes:
        return np.full(len(edges) - 1, np.nan, np.float32)
    last = ray.last
    if not len(last.t):
        return np.zeros(len(edges) - 1, np.float32)
    t = np.nan_to_num(last.t.astype(np.float64))
    until = np.clip(np.nan_to_num(last.until.astype(np.float64), nan=np.inf), t, np.append(t[1:], np.inf))
    until = np.where(np.isfinite(until) & (until < 1e9), until, t)  # endless: all its weight where it begins
    total = np.concatenate([[0], np.cumsum(np.nan_to_num(last.weights), dtype=np.float64)])
    knots = np.maximum.accumulate(np.stack([t, until], -1).ravel() + 1e-12 * np.arange(2 * len(t)))
    return np.diff(np.interp(edges, knots, np.stack([total[:-1], total[1:]], -1).ravel())).astype(np.float32)
