"""Keep a copy of a run, to return to if training breaks."""

from __future__ import annotations

import time
from typing import Any

from torch import Tensor

from nerf_core.training.trainer import Diverged, Trainer

GOOD_SECONDS = 20.0  # between two copies: at most this much training is lost if the loss diverges


class LastGood:
    """The last state of a trainer that is known to be finite. It is in host memory, in case the device is lost.

    description: that of `Trainer.describe()`.
    state: that of `Trainer.state()`, on the CPU.
    """

    description: dict[str, Any]
    state: dict[str, Tensor]

    def __init__(self, trainer: Trainer) -> None:
        """Copy the state as it is now. Raises Diverged if it is not finite."""
        self.remember(trainer)

    def due(self) -> bool:
        """Return whether GOOD_SECONDS have passed since the last copy."""
        return time.monotonic() - self._time >= GOOD_SECONDS

    def remember(self, trainer: Trainer) -> None:
        """Copy the state. Raises Diverged if it is not finite.

        A finite loss does not show that the weights are finite, because it is the loss of the weights before the step.
        """
        state = {name: value.detach().to("cpu", copy=True) for name, value in trainer.state().items()}
        broken = [n for n, v in state.items() if v.is_floating_point() and not bool(v.isfinite().all())]
        if broken:
            raise Diverged(f"step {trainer.step_count}: {broken[0]} is not finite; {trainer.advice}")
        self.description, self.state, self._time = trainer.describe(), state, time.monotonic()

    def restore(self, trainer: Trainer) -> None:
        """Return the trainer to the copied state."""
        trainer.go_to(self.description, self.state)
