"""How much the colour of a point depends on the direction from which it is seen."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.methods import Radiant

COMPARED = 64  # directions whose colours are compared


def view_dependence(method: Radiant, points: Tensor, towards: Tensor) -> Tensor:
    """How much the colours differ that points (P, 3) emit over the hemispheres that face `towards` (P, 3): (P,).

    The root of the mean square by which a channel differs from its mean over the hemisphere's directions, each as
    often as any other; 0 of a matt point, ½ at most. Directions that nobody has seen count as well.
    """
    directions = torch.from_numpy(_spread(2 * COMPARED)).to(points)
    rgb = method.radiance(points, -directions).to(points)
    facing = (towards.to(points) @ directions.T > 0).to(rgb)[..., None]
    count = facing.sum(1)
    mean = (rgb * facing).sum(1) / count
    return ((rgb - mean[:, None]).square() * facing).sum(1).div(count).mean(-1).sqrt()


def _spread(count: int) -> np.ndarray:
    """Unit directions (count, 3), evenly over the sphere: a spiral of equal areas that turns by the golden angle."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (3 - np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
