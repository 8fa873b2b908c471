"""The paper's priors on the reconstruction: smooth opacity in the volume, and pixels that are opaque or empty."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

FLOOR = 1e-5  # added to opacities before the logarithm, so that changes far below a visible opacity do not count
ROUND = 1e-5  # under the root, so that its gradient is finite where nothing changes
SOFT = 0.1  # keeps the logarithms of the opacity prior finite at 0 and 1
SURE = math.log(SOFT) + math.log(1 + SOFT)  # their sum at 0 and at 1, the least


def variation(opacity: Tensor, slab: int) -> Iterator[Tensor]:
    """Yield the total variation of log opacity in slabs, whose sum is the mean of ‖∇ log V_α‖ over the voxels.

    The gradient is that of forward differences between neighbouring voxels (Sec. "Reconstruction priors"; the published
    code's constants).

    Args:
        opacity: (N, N, N).
        slab: layers of a slab.
    """
    count = (opacity.shape[0] - 1) ** 3
    for z in range(0, opacity.shape[0] - 1, slab):
        log = torch.log(opacity[z : z + slab + 1] + FLOOR)
        here = log[:-1, :-1, :-1]
        squares = (log[1:, :-1, :-1] - here).square() + (log[:-1, 1:, :-1] - here).square()
        yield (squares + (log[:-1, :-1, 1:] - here).square() + ROUND).sqrt().sum() / count


def undecided(opacity: Tensor) -> Tensor:
    """Return how far pixels' opacities A (R,) are from 0 and 1: (R,), at least 0.

    It is log(0.1 + A) + log(1.1 − A), less its least value: up to a factor, the negative logarithm of the beta
    distribution with both parameters ½, whose mass is near 0 and 1 (Sec. "Reconstruction priors").
    """
    return torch.log(SOFT + opacity) + torch.log(1 + SOFT - opacity) - SURE
