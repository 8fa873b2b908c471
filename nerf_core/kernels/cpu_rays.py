"""Rays in the form that numba's loops read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays


class RayArrays(NamedTuple):
    origins: np.ndarray
    directions: np.ndarray
    views: np.ndarray
    near: np.ndarray
    far: np.ndarray
    offsets: np.ndarray


def ray_arrays(rays: BoxRays, offsets: Tensor) -> RayArrays:
    """Numpy views of rays. offsets: (R,), where each ray's first sample lies in its step, 0 … 1."""
    given = rays.origins, rays.directions, rays.views, rays.near, rays.far, offsets
    return RayArrays(*(v.contiguous().numpy() for v in given))
