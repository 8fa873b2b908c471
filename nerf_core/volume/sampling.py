"""Where along a ray to look: stratified depths, and draws from a piecewise-constant density."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Official constant: keeps a bin of zero weight reachable, and the PDF defined on a ray that hits nothing.
PDF_FLOOR = 1e-5


def spaced(
    near: Float[Tensor, " R"], far: Float[Tensor, " R"], count: int, disparity: bool
) -> Float[Tensor, "R count"]:
    """`count` depths from near to far, ends included, (R,) → (R, count); linear in t, or in 1/t."""
    u = torch.linspace(0, 1, count, device=near.device, dtype=near.dtype)
    near, far = near[:, None], far[:, None]
    if disparity:
        return 1 / ((1 - u) / near + u / far)
    return near + (far - near) * u


def stratified(t: Float[Tensor, "R S"], generator: torch.Generator) -> Float[Tensor, "R S"]:
    """Each depth (R, S) drawn anew, uniformly between the midpoints to its neighbours (half as wide at the ends).

    The official code's form of NeRF Eq. 2, whose bins are equal.
    """
    middle = (t[:, 1:] + t[:, :-1]) / 2
    lower = torch.cat([t[:, :1], middle], 1)
    upper = torch.cat([middle, t[:, -1:]], 1)
    return lower + (upper - lower) * torch.rand(t.shape, generator=generator, device=t.device, dtype=t.dtype)


def cumulative(weights: Float[Tensor, "R bins"]) -> Float[Tensor, "R edges"]:
    """The CDF (R, B + 1) at the edges of bins of such weights (R, B), from 0 to 1."""
    weights = weights + PDF_FLOOR
    pdf = weights / weights.sum(-1, keepdim=True)
    return torch.cat([torch.zeros_like(pdf[:, :1]), pdf.cumsum(-1)], -1)


def inverse_transform(
    edges: Float[Tensor, "R edges"], weights: Float[Tensor, "R bins"], count: int, generator: torch.Generator | None
) -> Float[Tensor, "R count"]:
    """`count` draws from the density that is constant within bins: NeRF, section 5.2.

    edges: (R, B + 1) ascending; weights: (R, B) ≥ 0, their sum at most 1 but for rounding, as of compositing.
    Uniform random draws with a generator, else evenly spaced quantiles 0 … 1. Returns (R, count), ascending without
    a generator, unsorted with one.
    """
    cdf = cumulative(weights)
    if generator is None:
        u = torch.linspace(0, 1, count, device=cdf.device, dtype=cdf.dtype).expand(len(cdf), count).contiguous()
    else:
        u = torch.rand(len(cdf), count, generator=generator, device=cdf.device, dtype=cdf.dtype)
    # cdf[-1] can round to just under 1, so the bin index is clamped to the last one
    bins = (torch.searchsorted(cdf, u, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    low, high = cdf.gather(-1, bins), cdf.gather(-1, bins + 1)
    left, right = edges.gather(-1, bins), edges.gather(-1, bins + 1)
    width = high - low  # at least PDF_FLOOR / (1 + B · PDF_FLOOR) > 0: the floor above is what makes this division safe
    return left + (right - left) * ((u - low) / width).clamp(0, 1)
