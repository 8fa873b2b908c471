"""Place samples along rays: stratified, or drawn from a piecewise-constant distribution."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# The official code's constant. It keeps bins of zero weight reachable, and the PDF defined on a ray that hits nothing.
PDF_FLOOR = 1e-5


def spaced(
    near: Float[Tensor, " R"], far: Float[Tensor, " R"], count: int, disparity: bool, trained: float = 0.0
) -> Float[Tensor, "R count"]:
    """Evenly spaced depths from near to far, both included.

    near, far: (R,). count: depths a ray. disparity: space them evenly in 1/t in place of t.
    trained: the least `near` of a training ray. A ray that begins nearer is spaced evenly in 1/(t + s), with
    s = trained − near: its first steps are as long as a training ray's, also if it begins at 0.
    Returns (R, count).
    """
    u = torch.linspace(0, 1, count, device=near.device, dtype=near.dtype)
    near, far = near[:, None], far[:, None]
    if disparity:
        shift = (trained - near).clamp(min=0)
        return 1 / ((1 - u) / (near + shift) + u / (far + shift)) - shift
    return near + (far - near) * u


def stratified(t: Float[Tensor, "R S"], generator: torch.Generator) -> Float[Tensor, "R S"]:
    """Move each depth to a uniformly random place between the midpoints to its neighbours.

    t: depths (R, S), ascending. generator: the source of the random numbers. Returns (R, S), ascending.
    """
    return within_bins(t, torch.rand(t.shape, generator=generator, device=t.device, dtype=t.dtype))


def within_bins(t: Float[Tensor, "R S"], u: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Move each depth to the place u in its bin: 0 … 1 between the midpoints to its neighbours.

    t: depths (R, S), ascending. u: (R, S) in [0, 1). Returns (R, S), ascending.
    This is the official code's form of NeRF Eq. 2. The equation's bins are equal; here the first and the last are half
    as wide.
    """
    middle = (t[:, 1:] + t[:, :-1]) / 2
    lower = torch.cat([t[:, :1], middle], 1)
    upper = torch.cat([middle, t[:, -1:]], 1)
    return lower + (upper - lower) * u


def cumulative(weights: Float[Tensor, "R bins"]) -> Float[Tensor, "R edges"]:
    """The CDF at the edges of bins, from 0 to 1: weights (R, B) → (R, B + 1)."""
    weights = weights + PDF_FLOOR
    pdf = weights / weights.sum(-1, keepdim=True)
    return torch.cat([torch.zeros_like(pdf[:, :1]), pdf.cumsum(-1)], -1)


def inverse_transform(
    edges: Float[Tensor, "R edges"], weights: Float[Tensor, "R bins"], count: int, generator: torch.Generator | None
) -> Float[Tensor, "R count"]:
    """Draw depths from the distribution that is constant within bins, by inverting its CDF: NeRF, section 5.2.

    edges: (R, B + 1), ascending. weights: (R, B) ≥ 0, such as those of compositing; a ray's sum is at most 1.
    count: draws a ray. generator: the source of the random numbers; None: evenly spaced quantiles 0 … 1.
    Returns (R, count): unsorted with a generator, ascending without one.
    """
    rays, like = len(weights), {"device": weights.device, "dtype": weights.dtype}
    if generator is None:
        u = torch.linspace(0, 1, count, **like).expand(rays, count).contiguous()
    else:
        u = torch.rand(rays, count, generator=generator, **like)
    return quantiles(edges, weights, u)


def quantiles(
    edges: Float[Tensor, "R edges"], weights: Float[Tensor, "R bins"], u: Float[Tensor, "R count"]
) -> Float[Tensor, "R count"]:
    """Return the depths at which the CDF of a distribution that is constant within bins is u.

    edges, weights: as for `inverse_transform`. u: (R, count) in [0, 1]. Returns (R, count) in the order of u.
    """
    cdf = cumulative(weights)
    # cdf[-1] can round to just under 1: the bin's index is limited to the last bin.
    bins = (torch.searchsorted(cdf, u, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    low, high = cdf.gather(-1, bins), cdf.gather(-1, bins + 1)
    left, right = edges.gather(-1, bins), edges.gather(-1, bins + 1)
    width = high - low  # at least PDF_FLOOR / (1 + B · PDF_FLOOR) > 0, so that the division is safe
    return left + (right - left) * ((u - low) / width).clamp(0, 1)
