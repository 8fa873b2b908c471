"""The planes that rays cross as samples along them."""

from __future__ import annotations

import torch
from torch import Tensor

from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.rays import Rays, Samples

MOST_ALPHA = 1 - 2**-20  # the logarithm of a density needs α < 1; float32 holds 1 − α with four bits from here
LEAST_SHARE = 1e-6  # of what a ray crosses: the least δ, where planes of two MPIs lie in the same place
SPENT = 1e-9  # transmittance in front of a sample below which rounding has eaten all of its digits


def plane_samples(
    name: str, ndc: Ndc | None, rays: Rays, t: Tensor, weights: Tensor, rgb: Tensor, real: Tensor
) -> Samples:
    """Sort the planes that each ray crosses, and express their weights as samples.

    With the weights W_i, which sum to at most 1: T_i = 1 − Σ_{j<i} W_j and α_i = W_i / T_i. A plane has an opacity and
    no thickness, so it has no density either. δ is the stretch to the next plane, and σ = −ln(1 − α) / δ is the density
    that would make the same α over that stretch. The last plane's stretch is as long as the one before it.

    Args:
        name: the name of the samples.
        ndc: the frustum of NDC, if the scene is trained in it: δ is then a length in NDC.
        rays: R rays.
        t: (S, R) world distances of the planes, in any order.
        weights: (S, R) the weight of each plane in the ray's colour.
        rgb: (S, R, 3) colours.
        real: (S, R) which planes the ray crosses; the others are left out.
    """
    count = real.sum(0)
    order = torch.where(real, t, torch.inf).sort(dim=0, stable=True).indices[: max(1, int(count.max()))].T
    real = torch.arange(order.shape[1], device=t.device) < count[:, None]
    last = (count - 1).clamp(min=0)[:, None]
    index = torch.where(real, order, order.gather(1, last))  # rays with fewer planes repeat their last one
    t = torch.where(count[:, None] > 0, t.T.gather(1, index), rays.near[:, None])
    rgb = torch.where(real[..., None], rgb.transpose(0, 1).gather(1, index[..., None].expand(-1, -1, 3)), 0)
    weight = torch.where(real, weights.T.gather(1, index), 0).double()
    before = (1 - (weight.cumsum(1) - weight)).clamp(0, 1)
    alpha = torch.where(before > SPENT, weight / before.clamp(min=SPENT), 0).clamp(max=MOST_ALPHA).float()
    transmittance = before.float()
    delta = _stretches(ndc, rays, t, count)
    sigma = -torch.log1p(-alpha) / delta
    return Samples(name, t, delta, sigma, alpha, transmittance, alpha * transmittance, rgb, count)


def _stretches(ndc: Ndc | None, rays: Rays, t: Tensor, count: Tensor) -> Tensor:
    """Return δ (R, S): the way to the next sample, in the world or in NDC, where a ray is straight too."""
    place = t.double()
    if ndc is not None:
        points = ndc.point(rays.origins.double()[:, None] + place[..., None] * rays.directions.double()[:, None])
        place = (points - points[:, :1]).norm(dim=-1)
    way = place.diff(dim=1)
    way = torch.cat([way, torch.zeros_like(place[:, :1])], 1)
    last = torch.arange(way.shape[1], device=t.device) == (count - 1).clamp(min=0)[:, None]
    before = way.roll(1, 1)
    before[:, 0] = (rays.far - rays.near).double() if ndc is None else 1.0  # a ray that crosses a single plane
    way = torch.where(last, before, way)
    return way.clamp(min=LEAST_SHARE * way.sum(1, keepdim=True).clamp(min=LEAST_SHARE)).float()
