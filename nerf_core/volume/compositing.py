"""Volume rendering: densities and colours along rays become pixels."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_core.geometry.rays import EMPTY


def absorb(
    sigma: Float[Tensor, "R S"], delta: Float[Tensor, "R S"]
) -> tuple[Float[Tensor, "R S"], Float[Tensor, "R S"], Float[Tensor, "R S"]]:
    """σ, δ (R, S) → α, T, w (R, S): NeRF Eq. 3 (arXiv:2003.08934).

    α_i = 1 − exp(−σ_i δ_i),  T_i = Π_{j<i} (1 − α_j) = exp(−Σ_{j<i} σ_j δ_j),  w_i = T_i α_i.
    The sum form of T needs no guard against log 0, and its gradient stays finite behind an opaque sample. With
    σ_1 = … = 0.1, δ = 1: α = 0.0952, T = 1, 0.905, 0.819, …
    """
    tau = sigma * delta
    alpha = -torch.expm1(-tau)
    # exclusive: the optical depth in front of a sample; the last one's may be infinite and is never used
    before = torch.cat([torch.zeros_like(tau[:, :1]), tau[:, :-1].cumsum(-1)], -1)
    transmittance = torch.exp(-before)
    return alpha, transmittance, alpha * transmittance


def composite(
    weights: Float[Tensor, "R S"], rgb: Float[Tensor, "R S 3"], background: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"]]:
    """C = Σ w_i c_i + (1 − Σ w_i) background: w (R, S), c (R, S, 3), (3,) → colour (R, 3), opacity (R,)."""
    opacity = weights.sum(-1)
    color = torch.einsum("rs,rsc->rc", weights, rgb) + (1 - opacity)[:, None] * background
    return color, opacity


def expected_depth(weights: Float[Tensor, "R S"], t: Float[Tensor, "R S"]) -> Float[Tensor, " R"]:
    """Σ w t / Σ w, (R,); NaN where the opacity is under `EMPTY`."""
    opacity = weights.sum(-1)
    nothing = opacity < EMPTY
    depth = (weights * t).sum(-1) / torch.where(nothing, torch.ones_like(opacity), opacity)
    return torch.where(nothing, torch.full_like(depth, torch.nan), depth)
