"""From packed samples, as the fast methods have them, to the same number of samples on every ray."""

from __future__ import annotations

import torch
from torch import Tensor

from nerf_core.kernels.packed_kernels import Samples as Packed
from nerf_core.spaces import Space
from nerf_core.types import Rays, Samples, Trace


def to_trace(name: str, space: Space, rays: Rays, packed: Packed, tau: Tensor, rgb: Tensor, pixel: Tensor) -> Trace:
    """Optical depths (M,), colours (M, 3) and pixels (R, 5) of packed samples, opened up.

    Shorter rays are filled up behind their last sample: there t and δ repeat, and nothing absorbs.
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
    light = torch.exp(-(depth.cumsum(-1) - depth))
    samples = Samples(name, space.world_t(rays, t), delta, depth / delta, alpha, light, alpha * light, color)
    return Trace(space.rendering(rays, pixel), (samples,))
