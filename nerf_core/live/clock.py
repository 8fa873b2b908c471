"""When a ray that is kept open is opened anew."""

from __future__ import annotations

import time
from dataclasses import dataclass

from nerf_core.training.trainer import Trainer

REFRESH_SECONDS = {"cpu": 0.4, "cuda": 0.09}  # between two looks while training goes on: 2 and 10 a second
PART = 0.15  # of the time at most: where a look takes longer, it comes more rarely


@dataclass
class RefreshClock:
    """Decides when the next look at a ray is due.

    step: the training step of the last look.
    ended: when it ended, in seconds of the monotonic clock.
    took: how long it took, in seconds.
    """

    step: int = -1
    ended: float = -1e9
    took: float = 0.0

    def due(self, trainer: Trainer, training: bool) -> bool:
        """Whether the model has changed since; while training goes on also, whether enough time has passed."""
        if self.step == trainer.step_count or not training:
            return self.step != trainer.step_count
        every = max(REFRESH_SECONDS.get(trainer.device.type, 0.4), self.took / PART)
        return time.monotonic() - self.ended > every

    def begin(self, trainer: Trainer) -> None:
        self.step, self.took = trainer.step_count, 0.0

    def worked(self, seconds: float) -> None:
        self.took += seconds
        self.ended = time.monotonic()

    def reset(self) -> None:
        self.step, self.ended = -1, -1e9
