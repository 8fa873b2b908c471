"""Samples stored ray after ray in one array, because the fast methods place a different number on each ray."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays, Samples, Trace
from nerf_core.geometry.spaces import Space

OPAQUE = 800.0  # optical depth from which e^−τ is 0 in 64 bits


@dataclass(frozen=True)
class Packed:
    """M samples of R rays, ray after ray, each ray's from front to back.

    row_offsets: (R + 1,) int64; ray r has the samples row_offsets[r] … row_offsets[r + 1] − 1.
    t, width: (M,), position and length of each sample, in the parameter of the box rays.
    """

    row_offsets: Tensor
    t: Tensor
    width: Tensor

    @property
    def ray(self) -> Tensor:
        """The ray of each sample, (M,)."""
        counts = self.row_offsets.diff()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)

    def before(self, tau: Tensor) -> Tensor:
        """The optical depth in front of each sample: (M,) → (M,) float64.

        It is the running sum over all samples, minus its value where the ray begins. A sample counts as OPAQUE at
        most, because a sum that contains 10¹² would lose the small values of the other rays.
        """
        tau = tau.double().clamp(max=OPAQUE)
        running = tau.cumsum(0) - tau
        if not len(tau):
            return running
        return running - running[self.row_offsets[:-1].clamp(max=len(tau) - 1)][self.ray]


def opened(name: str, space: Space, rays: Rays, packed: Packed, tau: Tensor, rgb: Tensor) -> Samples:
    """Convert packed samples to `Samples`, which have the same number of samples on every ray.

    tau: optical depths (M,). rgb: colours (M, 3).
    Rays with fewer samples are padded behind their last one: t and δ repeat, and the optical depth is 0. The padding
    of a ray without samples lies where the box begins.
    """
    counts = packed.row_offsets.diff()
    most = max(1, int(counts.max())) if len(counts) else 1
    place = torch.arange(most, device=tau.device)
    index = (packed.row_offsets[:-1, None] + torch.minimum(place, (counts - 1).clamp(min=0)[:, None])).clamp(
        max=len(tau) - 1
    )
    real = place < counts[:, None]
    boxed = space.rays(rays)
    stretch = boxed.directions.norm(dim=-1) if space.kind == "ndc" else torch.ones_like(boxed.near)
    if len(tau):
        t, delta = packed.t[index], packed.width[index]
        depth, color = torch.where(real, tau[index], 0), torch.where(real[..., None], rgb[index], 0)
    else:
        t = delta = depth = torch.zeros(len(rays), most, device=tau.device)
        color = torch.zeros(len(rays), most, 3, device=tau.device)
    some = counts[:, None] > 0
    t = torch.where(some, t, boxed.near[:, None])
    delta = torch.where(some, delta, 1.0) * stretch[:, None]
    alpha = -torch.expm1(-depth)
    # The sum excludes the sample itself, whose optical depth is infinite if it has no end.
    transmittance = torch.exp(-torch.cat([torch.zeros_like(depth[:, :1]), depth[:, :-1].cumsum(-1)], -1))
    return Samples(
        name, space.world_t(rays, t), delta, depth / delta, alpha, transmittance, alpha * transmittance, color, counts
    )


def to_trace(name: str, space: Space, rays: Rays, packed: Packed, tau: Tensor, rgb: Tensor, pixel: Tensor) -> Trace:
    """The trace of rays with one pass: their samples, and the pixels (R, 5) that they composited to."""
    return Trace(space.rendering(rays, pixel), (opened(name, space, rays, packed, tau, rgb),))
