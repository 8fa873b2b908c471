"""Walk along rays through the scene's box in equal steps, and add up opacity until it is 1."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays
from nerf_core.geometry.spaces import BoxRays, Space, contract

PARALLEL = 1e-12  # stands for a direction's component of 0, so that 0/0 does not occur at the box's faces
# Contracted space is walked up to this distance, in multiples of where contraction begins: 10⁻⁴ of the box is left.
FARTHEST = 1e4
MOST_SAMPLES = 2048  # of a ray: a template of 256³ with half steps takes 1,774 along its diagonal


class March(NamedTuple):
    """Samples of R rays in a rectangle of R × S; `real` says which of them there are.

    t, delta: (R, S) where a sample's stretch begins, and its length, in the parameter of the box rays.
    length: (R, S) its length in the box, in units of the box's half side; 0 where there is no sample.
    real: (R, S) bool. A ray's real samples are its first ones.
    u: (P, 3) the real samples' places in the cube [−1, 1]³, ray after ray.
    """

    t: Tensor
    delta: Tensor
    length: Tensor
    real: Tensor
    u: Tensor


class Box:
    """The scene's box as the cube [−1, 1]³ of the template.

    half: half of the box's longest side, in box coordinates.
    """

    def __init__(self, space: Space, device: torch.device) -> None:
        self.space = space
        self.low = torch.tensor(space.low, dtype=torch.float32, device=device)
        self.high = torch.tensor(space.high, dtype=torch.float32, device=device)
        self.half = float((space.high - space.low).max()) / 2

    def cube(self, x: Tensor) -> Tensor:
        """Map box coordinates (P, 3) to the cube."""
        return (x - self.low) / (self.high - self.low) * 2 - 1

    def march(self, rays: Rays, step: float, offsets: Tensor) -> March:
        """Place samples along R rays.

        Args:
            rays: R rays.
            step: length of a sample, in units of the box's half side; more where a ray would have over MOST_SAMPLES.
            offsets: (R,) in [0, 1], the share of a step at which the first sample lies behind the box's entry. In
                training it is random (Sec. "Ray marching"; the published code), so that in time every place is sampled.
        """
        boxed = self.space.rays(rays)
        speed = boxed.directions.norm(dim=-1)
        first, last, bend = self._bounds(boxed, speed)
        # From far outside of contracted space, equal steps would be far too many in front of its inner cube, where
        # little is: a ray takes at most MOST_SAMPLES, which are then longer.
        ds = torch.maximum(step * self.half / speed, (last - first) / MOST_SAMPLES)[:, None]
        steps = ((last - first)[:, None] / ds - offsets[:, None]).clamp(min=0).ceil()
        most = max(1, int(steps.max())) if len(rays) else 1
        k = torch.arange(most, device=ds.device)
        real = k < steps
        s = torch.minimum(first[:, None] + (k + offsets[:, None]) * ds, torch.maximum(first, last)[:, None])
        end = torch.minimum(s + ds, torch.maximum(first, last)[:, None])
        t, until = _unbent(s, bend), _unbent(end, bend)
        x = self._points(boxed, t, real)
        if self.space.kind == "contracted":
            behind = self._points(boxed, until, real)
            length = torch.zeros_like(t).masked_scatter(real, (behind - x).norm(dim=-1) / self.half)
        else:
            length = torch.where(real, (end - s) * speed[:, None] / self.half, 0)
        return March(t, until - t, length, real, self.cube(x).clamp(-1, 1))

    def _points(self, boxed: BoxRays, t: Tensor, real: Tensor) -> Tensor:
        """The places (P, 3) of the real samples, in box coordinates."""
        ray = real.nonzero()[:, 0]
        x = boxed.origins[ray] + t[real][:, None] * boxed.directions[ray]
        return contract(x) if self.space.kind == "contracted" else x

    def _bounds(self, boxed: BoxRays, speed: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return where the walk begins and ends (R,), and where contraction begins (R,), if there is one.

        The walk's parameter is s = t, and behind the bend b it is s = (2 − b/t) b, so that equal steps of s are about
        equal steps in contracted space.
        """
        if self.space.kind != "contracted":
            entry, leave = _crossing(boxed, self.low, self.high)
            return torch.maximum(entry, boxed.near), torch.minimum(leave, boxed.far), None
        inner = torch.ones_like(self.low)
        entry, leave = _crossing(boxed, -inner, inner)
        nearest = -(boxed.origins * boxed.directions).sum(-1) / speed.square()
        bend = torch.where((leave > entry) & (leave > 0), leave, nearest)
        bend = torch.maximum(bend, torch.maximum(boxed.near, 1 / speed))
        return boxed.near, (2 - 1 / FARTHEST) * bend, bend


def _crossing(boxed: BoxRays, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return where rays enter and leave a box, (R,) each; they miss it where they leave before they enter."""
    direction = torch.where(boxed.directions.abs() < PARALLEL, PARALLEL, boxed.directions)
    a, b = (low - boxed.origins) / direction, (high - boxed.origins) / direction
    return torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)


def _unbent(s: Tensor, bend: Tensor | None) -> Tensor:
    """The inverse of s(t), see `_bounds`."""
    if bend is None:
        return s
    b = bend[:, None]
    return torch.where(s <= b, s, b / (2 - s / b).clamp(min=1 / FARTHEST / 2))


def add_up(opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Composite additively: return the transmittance before each sample and its weight, (R, S) each.

    opacity: (R, S) V_α δ of each sample.

    The opacity along the ray is A_i = min(Σ_{j≤i} V_α δ_j, 1), and a sample's weight is its increase, w_i = A_i −
    A_{i−1} (Sec. "Ray marching"). So a sample takes no share of the light that reaches it, as in NeRF, but a fixed
    amount; the one that makes A reach 1 takes what is left, and those behind it get nothing.
    """
    total = opacity.cumsum(-1).clamp(max=1)
    before = torch.cat([torch.zeros_like(total[:, :1]), total[:, :-1]], -1)
    return 1 - before, total - before
