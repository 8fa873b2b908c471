"""Volume rendering: turn densities and colours along rays into pixels."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_core.geometry.rays import EMPTY

STOP = 1e-3  # transmittance below which the rest of a ray changes an 8-bit pixel by less than one level


def absorb(
    sigma: Float[Tensor, "R S"], delta: Float[Tensor, "R S"]
) -> tuple[Float[Tensor, "R S"], Float[Tensor, "R S"], Float[Tensor, "R S"]]:
    """Opacity, transmittance and weight of each sample: NeRF Eq. 3 (arXiv:2003.08934).

    sigma: densities (R, S) of R rays with S samples each, per unit of length. delta: the samples' lengths (R, S).
    Returns α, T and w, each (R, S):
        α_i = 1 − exp(−σ_i δ_i),  T_i = Π_{j<i} (1 − α_j) = exp(−Σ_{j<i} σ_j δ_j),  w_i = T_i α_i.
    T is computed as a sum because this needs no guard against log 0, and because its gradient stays finite behind an
    opaque sample. Example: with σ_1 = … = 0.1 and δ = 1, α = 0.0952 and T = 1, 0.905, 0.819, …
    """
    tau = sigma * delta
    alpha = -torch.expm1(-tau)
    # The sum excludes the sample itself. The optical depth of the last sample may be infinite; it is not used here.
    before = torch.cat([torch.zeros_like(tau[:, :1]), tau[:, :-1].cumsum(-1)], -1)
    transmittance = torch.exp(-before)
    return alpha, transmittance, alpha * transmittance


def composite(
    weights: Float[Tensor, "R S"], rgb: Float[Tensor, "R S 3"], background: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"]]:
    """Composite samples over a background: C = Σ w_i c_i + (1 − Σ w_i) background.

    weights: (R, S). rgb: (R, S, 3). background: (3,).
    Returns the colour (R, 3) and the opacity Σ w_i (R,).
    """
    opacity = weights.sum(-1)
    color = torch.einsum("rs,rsc->rc", weights, rgb) + (1 - opacity)[:, None] * background
    return color, opacity


def expected_depth(weights: Float[Tensor, "R S"], t: Float[Tensor, "R S"]) -> Float[Tensor, " R"]:
    """The mean depth Σ w t / Σ w of each ray (R,), NaN where the opacity is under `EMPTY`.

    weights, t: (R, S).
    """
    opacity = weights.sum(-1)
    nothing = opacity < EMPTY
    depth = (weights * t).sum(-1) / torch.where(nothing, torch.ones_like(opacity), opacity)
    return torch.where(nothing, torch.full_like(depth, torch.nan), depth)
