"""A copy of a run to fall back on when training breaks."""

from __future__ import annotations

import time
from typing import Any

from torch import Tensor

from nerf_core.training.trainer import Diverged, Trainer

GOOD_SECONDS = 20.0  # between copies: so much is lost when the loss diverges


class LastGood:
    """The trainer's state as it last was known to be finite, on the host, where a lost device cannot take it."""

    description: dict[str, Any]
    state: dict[str, Tensor]

    def __init__(self, trainer: Trainer) -> None:
        self.remember(trainer)

    def due(self) -> bool:
        return time.monotonic() - self._time >= GOOD_SECONDS

    def remember(self, trainer: Trainer) -> None:
        """Copy the state. Raises Diverged where it is not finite: a step's loss is that of the weights before it."""
        state = {name: value.detach().to("cpu", copy=True) for name, value in trainer.state().items()}
        broken = [n for n, v in state.items() if v.is_floating_point() and not bool(v.isfinite().all())]
        if broken:
            raise Diverged(
                f"step {trainer.step_count}: {broken[0]} is not finite; lower the learning rate (--set learning_rate=…)"
            )
        self.description, self.state, self._time = trainer.describe(), state, time.monotonic()

    def restore(self, trainer: Trainer) -> None:
        trainer.go_to(self.description, self.state)
