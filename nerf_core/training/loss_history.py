"""Record the loss over the steps, thinned so that the plot of a whole training stays small."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

LIMIT = 2000  # points; when there are so many, they are thinned to half
EVERY = {2**k for k in range(40)}  # possible numbers of steps per point
MOST = 1e30  # a loss must be smaller, because the plot has 32 bits


@dataclass(frozen=True)
class History:
    """The loss of the training so far, as N < LIMIT points.

    step: (N,) int64, the last step of each point.
    loss: (N,) float32, the mean squared error, a mean over the steps of the point.
    psnr: (N,) float32, −10 log₁₀ of that loss, in dB.
    """

    step: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    loss: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    psnr: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))


class HistoryLog:
    """Collects the loss as means over `every` steps.

    When there are LIMIT points, each two neighbours are averaged and `every` doubles.
    """

    def __init__(self) -> None:
        self.every = 1
        self._steps: list[int] = []
        self._losses: list[float] = []
        self._pending: list[float] = []
        self._view = History()
        self._changed = False

    def add(self, step: int, loss: float) -> None:
        """Add the loss of a step."""
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

    def state(self) -> dict[str, np.ndarray]:
        """Return what a log needs to continue from here, by name, for a checkpoint."""
        every, steps = (np.array(v, np.int64) for v in (self.every, self._steps))
        losses, pending = (np.array(v, np.float64) for v in (self._losses, self._pending))
        return {"every": every, "steps": steps, "losses": losses, "pending": pending}

    def load_state(self, state: Mapping[str, np.ndarray], step: int) -> None:
        """Continue from `state`.

        Args:
            state: that of `state()`. It may be empty, because checkpoints of old versions have no history.
            step: the training step at which it was taken.

        Raises:
            KeyError, ValueError: `state()` cannot have returned this.
        """
        if not state:
            state = HistoryLog().state()
        every, steps, losses, pending = (state[name] for name in ("every", "steps", "losses", "pending"))
        kinds = [v.dtype for v in (every, steps, losses, pending)]
        shapes = every.ndim, steps.ndim, pending.ndim
        if kinds != 2 * [np.int64] + 2 * [np.float64] or shapes != (0, 1, 1) or steps.shape != losses.shape:
            raise ValueError("its losses are not a curve")
        made, numbers = np.concatenate([[0], steps, [step + 1]]), np.concatenate([losses, pending])
        if not (
            int(every) in EVERY and len(steps) < LIMIT and len(pending) < int(every) and (np.diff(made) > 0).all()
            and ((numbers >= 0) & (numbers < MOST)).all()
        ):  # fmt: skip
            raise ValueError(f"its losses are not those of {step} steps")
        self.every, self._steps = int(every), steps.tolist()
        self._losses, self._pending, self._changed = losses.tolist(), pending.tolist(), True

    def view(self) -> History:
        """Return the points so far. The same object is returned until there is a new point."""
        if self._changed:
            loss = np.array(self._losses, np.float32)
            # 1e-10, the loss of 100 dB, takes the place of 0, which has no logarithm
            psnr = (-10 * np.log10(np.maximum(loss, 1e-10))).astype(np.float32)
            self._view, self._changed = History(np.array(self._steps, np.int64), loss, psnr), False
        return self._view
