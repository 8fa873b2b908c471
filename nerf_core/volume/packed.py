"""Samples packed ray after ray, as the fast methods have them, since rays need different numbers of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays, Samples, Trace
from nerf_core.geometry.spaces import Space

OPAQUE = 800.0  # optical depth behind which e^−τ is 0 in 64 bits


@dataclass(frozen=True)
class Packed:
    """M samples, ray after ray, front to back. ends: (R + 1,) int64, where each ray's samples begin, and M.

    t, width: (M,) of the box rays' parameter.
    """

    ends: Tensor
    t: Tensor
    width: Tensor

    @property
    def ray(self) -> Tensor:
        """(M,) the ray of each sample."""
        counts = self.ends.diff()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)

    def before(self, tau: Tensor) -> Tensor:
        """Optical depth (M,) float64 in front of each sample: a running sum, less what it was where the ray began.

        A sample counts as OPAQUE at most: in a sum with 10¹² nothing would be left of the others.
        """
        tau = tau.double().clamp(max=OPAQUE)
        running = tau.cumsum(0) - tau
        if not len(tau):
            return running
        return running - running[self.ends[:-1].clamp(max=len(tau) - 1)][self.ray]


def opened(name: str, space: Space, rays: Rays, packed: Packed, tau: Tensor, rgb: Tensor) -> Samples:
    """Optical depths (M,) and colours (M, 3) of packed samples as the same number of samples on every ray.

    Shorter rays are filled up behind their last sample: there t and δ repeat, and nothing absorbs. A ray without any
    has stand-ins where the box begins.
    """
    counts = packed.ends.diff()
    most = max(1, int(counts.max())) if len(counts) else 1
    place = torch.arange(most, device=tau.device)
    index = (packed.ends[:-1, None] + torch.minimum(place, (counts - 1).clamp(min=0)[:, None])).clamp(max=len(tau) - 1)
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
    # exclusive: what is in front of a sample without end must not be told from its infinite depth
    light = torch.exp(-torch.cat([torch.zeros_like(depth[:, :1]), depth[:, :-1].cumsum(-1)], -1))
    return Samples(name, space.world_t(rays, t), delta, depth / delta, alpha, light, alpha * light, color, counts)


def to_trace(name: str, space: Space, rays: Rays, packed: Packed, tau: Tensor, rgb: Tensor, pixel: Tensor) -> Trace:
    """The one pass that made pixels (R, 5), opened up."""
    return Trace(space.rendering(rays, pixel), (opened(name, space, rays, packed, tau, rgb),))
