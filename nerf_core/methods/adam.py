"""torch's Adam in its fused form, which reads and writes each parameter once, and its state in a checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from inspect import unwrap
from typing import Any

import torch
from torch import Tensor


class Adam(torch.optim.Adam):
    """torch's Adam, fused, without torch's compiler.

    The wrappers of torch's own functions keep that compiler away from them, and import it for that. It takes 0.7 s and
    100 MB, and nothing here has any use for it.
    """

    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    load_state_dict = unwrap(torch.optim.Adam.load_state_dict)
    step = torch.no_grad()(unwrap(torch.optim.Adam.step))

    def __init__(self, parameters: Iterable[Tensor], lr: float | Tensor, **options: Any) -> None:
        super().__init__(parameters, lr=lr, fused=True, **options)


def adam_state(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """Return moments and step counts by name, as adam.<parameter>.<name>."""
    states = optimizer.state_dict()["state"]
    return {f"adam.{i}.{name}": value for i, slots in states.items() for name, value in slots.items()}


def load_adam(optimizer: torch.optim.Adam, parameters: Sequence[Tensor], state: Mapping[str, Tensor]) -> None:
    """Restore an optimiser from `adam_state`. Raises ValueError if the state does not fit the parameters.

    A state from before the first step has no moments. Shapes are checked here because the fused kernel does not check
    them: it would write past the end of a tensor that is too small.
    """
    slots: dict[int, dict[str, Any]] = {}
    for key, value in state.items():
        if key.startswith("adam."):
            _, i, slot = key.split(".")
            slots.setdefault(int(i), {})[slot] = (
                value.clone()
            )  # a copy, because Adam keeps the tensor and writes into it
    for i, parameter in enumerate(parameters if slots else ()):
        shapes = {name: (value.shape, value.dtype) for name, value in slots.get(i, {}).items()}
        moment = (parameter.shape, parameter.dtype)
        if shapes != {"step": (torch.Size(), torch.float32), "exp_avg": moment, "exp_avg_sq": moment}:
            raise ValueError(f"the optimiser's state of parameter {i} does not fit")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": slots})
