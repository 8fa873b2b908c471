"""γ: what a network is given instead of bare coordinates."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def frequency_width(frequencies: int, include_input: bool = True) -> int:
    """Outputs a coordinate triple is turned into: 3·2·L, and 3 more for the raw input."""
    return 3 * (2 * frequencies + (1 if include_input or frequencies == 0 else 0))


def frequency(
    p: Float[Tensor, "P 3"], frequencies: int, include_input: bool = True, pi: bool = False
) -> Float[Tensor, "P width"]:
    """γ(p) = (p, sin 2⁰p, cos 2⁰p, …, sin 2^{L−1}p, cos 2^{L−1}p): p (P, 3) → (P, frequency_width), float32.

    NeRF Eq. 4 (arXiv:2003.08934) has 2^k π p and no raw input; the official code, from which the published numbers
    come, drops π and appends p (63 and 27 outputs for L = 10 and 4). `pi` and `include_input` choose.
    No frequencies: p itself, whatever `include_input` says, since a network needs some input.
    """
    if frequencies == 0:
        return p
    scales = torch.exp2(torch.arange(frequencies, device=p.device, dtype=p.dtype)) * (math.pi if pi else 1.0)
    angles = p[:, None, :] * scales[:, None]  # (P, L, 3)
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], 2).flatten(1)
    return torch.cat([p, waves], 1) if include_input else waves
