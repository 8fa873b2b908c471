"""What a checkpoint holds of torch's Adam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


def adam_state(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """Moments and step counts as adam.<parameter>.<name>."""
    states = optimizer.state_dict()["state"]
    return {f"adam.{i}.{name}": value for i, slots in states.items() for name, value in slots.items()}


def load_adam(optimizer: torch.optim.Adam, parameters: Sequence[Tensor], state: Mapping[str, Tensor]) -> None:
    """Be where `adam_state` was taken. Raises ValueError where it does not fit the parameters.

    Before the first step there are none. The fused kernel trusts them: past the end of one that is too small it would
    write all the same.
    """
    slots: dict[int, dict[str, Any]] = {}
    for key, value in state.items():
        if key.startswith("adam."):
            _, i, slot = key.split(".")
            slots.setdefault(int(i), {})[slot] = value.clone()  # Adam keeps what it is given and writes into it
    for i, parameter in enumerate(parameters if slots else ()):
        shapes = {name: (value.shape, value.dtype) for name, value in slots.get(i, {}).items()}
        moment = (parameter.shape, parameter.dtype)
        if shapes != {"step": (torch.Size(), torch.float32), "exp_avg": moment, "exp_avg_sq": moment}:
            raise ValueError(f"the optimiser's state of parameter {i} does not fit")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": slots})
