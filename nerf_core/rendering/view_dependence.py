"""Measure how much the colour of a point depends on the direction from which it is seen."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.methods import Radiant

COMPARED = 64  # directions in a hemisphere


def view_dependence(method: Radiant, points: Tensor, towards: Tensor) -> Tensor:
    """Return the standard deviation of the colour that a point emits, over the directions of a hemisphere.

        √( mean over channels c and directions v of (c(x, −v) − mean over v of c(x, −v))² )

    The directions are spread evenly over the hemisphere, including those that no photo has seen.

    Args:
        method: a model that has a radiance at a point.
        points: (P, 3) the points x, in world units.
        towards: (P, 3) the directions that the hemispheres face, from the points outwards.

    Returns:
        (P,) from 0, for a matt point, to ½.
    """
    directions = torch.from_numpy(_spread(2 * COMPARED)).to(points)
    rgb = method.radiance(points, -directions).to(points)
    facing = (towards.to(points) @ directions.T > 0).to(rgb)[..., None]
    count = facing.sum(1)
    mean = (rgb * facing).sum(1) / count
    return ((rgb - mean[:, None]).square() * facing).sum(1).div(count).mean(-1).sqrt()


def _spread(count: int) -> np.ndarray:
    """Return unit directions (count, 3), evenly over the sphere.

    They lie on a spiral: each stands for the same area and is turned by the golden angle from the one before.
    """
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (3 - np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
