"""Cameras of Flatland on a ring, and the rays of their pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

RADIUS = 1.4  # of the ring of cameras
REACH = 1.0  # radius of the disc around the origin that holds the world: all samples lie in it
PIXELS = 64  # of a photo
HALF_WIDTH = REACH / math.sqrt(RADIUS**2 - REACH**2)  # of a photo at distance 1: its edges touch the disc
MOST_HELD_OUT = 8


@dataclass(frozen=True)
class FlatRays:
    """Rays of Flatland.

    origins, directions: (R, 2); directions of unit length.
    near, far: (R,); between these distances along a ray lie its samples.
    """

    origins: Float[Tensor, "R 2"]
    directions: Float[Tensor, "R 2"]
    near: Float[Tensor, " R"]
    far: Float[Tensor, " R"]

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: slice | Tensor) -> FlatRays:
        return FlatRays(self.origins[index], self.directions[index], self.near[index], self.far[index])

    def split(self, count: int) -> Iterator[FlatRays]:
        """Yield them in parts of at most `count`."""
        for start in range(0, len(self), count):
            yield self[start : start + count]

    def points(self, t: Float[Tensor, "R S"]) -> Float[Tensor, "P 2"]:
        """Return the points o + t d at distances t (R, S), ray after ray."""
        return (self.origins[:, None] + t[..., None] * self.directions[:, None]).flatten(0, 1)


def ring(count: int) -> tuple[list[float], list[float]]:
    """Return the angles of training cameras and of held-out ones on the ring, in radians.

    Held-out cameras lie in the middle between two neighbours. At most `MOST_HELD_OUT` gaps have one, evenly chosen.
    """
    step = 2 * math.pi / count
    held_out = min(count, MOST_HELD_OUT)
    gaps = [k * count // held_out for k in range(held_out)]
    return [k * step for k in range(count)], [(k + 0.5) * step for k in gaps]


def camera_rays(angles: list[float]) -> FlatRays:
    """Return the rays of all pixels of cameras at these angles of the ring, camera after camera. They face the middle.

    Pixel 0 is the leftmost one, as the camera looks. A ray's samples lie where it crosses the disc of radius `REACH`.
    """
    angle = torch.tensor(angles, dtype=torch.float64)[:, None]
    outwards = torch.stack([torch.cos(angle), torch.sin(angle)], -1)  # (N, 1, 2)
    left = torch.stack([torch.sin(angle), -torch.cos(angle)], -1)  # of a camera that looks along −outwards
    across = 1 - 2 * (torch.arange(PIXELS, dtype=torch.float64) + 0.5) / PIXELS  # 1 is the left edge
    directions = -outwards + HALF_WIDTH * across[:, None] * left
    directions = (directions / directions.norm(dim=-1, keepdim=True)).flatten(0, 1)
    origins = (RADIUS * outwards).expand(-1, PIXELS, -1).flatten(0, 1)
    middle = -(origins * directions).sum(-1)
    half = (REACH**2 - (origins + middle[:, None] * directions).square().sum(-1)).clamp(min=0).sqrt()
    return FlatRays(origins.float(), directions.float(), (middle - half).float(), (middle + half).float())
