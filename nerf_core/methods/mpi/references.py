"""Choose the reference views of the MPIs, and how much each counts in a pixel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def spread_out(positions: np.ndarray, count: int) -> list[int]:
    """Return `count` of the places (N, 3), well spread: the most central one, then always the farthest from those.

    Fewer if there are not so many different places. The first ones of a longer list are the shorter list.
    """
    chosen = [int(((positions - positions.mean(0)) ** 2).sum(1).argmin())]
    distance = ((positions - positions[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((positions - positions[chosen[-1]]) ** 2).sum(1))
    return chosen


def blending(distances: Tensor, nearest: int, falloff: float) -> Tensor:
    """Return the weights β (R, K) of K reference views for R rays. They add up to 1.

    LLFF (arXiv:1905.00889, section 4.2) gives the nearest views the weights exp(−γ ℓ_k), where ℓ_k is the distance of
    the view. Here β_k ∝ exp(−γ ℓ_k) ℓ_min / ℓ_k, with ℓ_min the smallest distance. The second factor is this program's
    own: at the place of a reference view all other weights are 0, so that the picture there is the MPI itself.

    Args:
        distances: (R, K) ℓ.
        nearest: how many views count; the others have weight 0.
        falloff: γ, per unit of length.
    """
    count = distances.shape[1]
    near, index = distances.topk(min(nearest, count), largest=False, sorted=True)
    # 1e-30: at the place of the nearest view, 0 / 0 becomes 0 / 1e-30 for the others and 1 for itself
    weight = torch.exp(-falloff * (near - near[:, :1])) * near[:, :1] / near.clamp(min=1e-30)
    weight[:, 0] = 1
    return torch.zeros_like(distances).scatter_(1, index, weight / weight.sum(1, keepdim=True))
