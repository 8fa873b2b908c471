"""Loss over steps, thinned so that a plot of a whole training stays small."""

from __future__ import annotations

import numpy as np

from nerf_core.messages import History

LIMIT = 2000


class HistoryLog:
    """Means over runs of `every` steps; when there are LIMIT of them, neighbours are joined and `every` doubles."""

    def __init__(self) -> None:
        self.every = 1
        self._steps: list[int] = []
        self._losses: list[float] = []
        self._pending: list[float] = []
        self._view = History()
        self._changed = False

    def add(self, step: int, loss: float) -> None:
        self._pending.append(loss)
        if len(self._pending) < self.every:
            return
        self._steps.append(step)
        self._losses.append(float(np.mean(self._pending)))
        self._pending = []
        self._changed = True
        if len(self._steps) >= LIMIT:
            self._steps = self._steps[1::2]
            self._losses = [(a + b) / 2 for a, b in zip(self._losses[::2], self._losses[1::2], strict=True)]
            self.every *= 2

    def rewind(self, step: int) -> None:
        """Forget what came after `step`: training went back to it."""
        kept = sum(s <= step for s in self._steps)
        self._steps, self._losses, self._pending = self._steps[:kept], self._losses[:kept], []
        self._changed = True

    def view(self) -> History:
        if self._changed:
            loss = np.array(self._losses, np.float32)
            # 1e-10, the loss of 100 dB, stands in for zero, whose logarithm has no value
            psnr = (-10 * np.log10(np.maximum(loss, 1e-10))).astype(np.float32)
            self._view, self._changed = History(np.array(self._steps, np.int64), loss, psnr), False
        return self._view
