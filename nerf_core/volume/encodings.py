"""Encodings of positions and directions, which a network receives in place of the bare coordinates."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def frequency_width(frequencies: int, include_input: bool = True, dimensions: int = 3) -> int:
    """Number of outputs of `frequency` for a point of D dimensions: D·2·L, and D more with the raw input."""
    return dimensions * (2 * frequencies + (1 if include_input or frequencies == 0 else 0))


def frequency(
    p: Float[Tensor, "P dim"], frequencies: int, include_input: bool = True, pi: bool = False
) -> Float[Tensor, "P width"]:
    """Positional encoding γ(p) = (p, sin 2⁰p, cos 2⁰p, …, sin 2^{L−1}p, cos 2^{L−1}p).

    p: points (P, D), of three dimensions in a scene. frequencies: L. include_input: whether p itself is part of the
    output. pi: multiply p by π.
    Returns (P, frequency_width(L, include_input, D)) float32.

    NeRF Eq. 4 (arXiv:2003.08934) uses 2^k π p and no raw input. The official code, from which the published numbers
    come, drops π and adds p: 63 outputs for L = 10, 27 for L = 4.
    With L = 0 the output is p, whatever `include_input` says, because a network needs some input.
    """
    if frequencies == 0:
        return p
    scales = torch.exp2(torch.arange(frequencies, device=p.device, dtype=p.dtype)) * (math.pi if pi else 1.0)
    angles = p[:, None, :] * scales[:, None]  # (P, L, D)
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], 2).flatten(1)
    return torch.cat([p, waves], 1) if include_input else waves


def spherical_harmonics(d: Float[Tensor, "P 3"]) -> Float[Tensor, "P 16"]:
    """The 16 real spherical harmonics of degree 0 … 3, orthonormal over the sphere.

    d: unit directions (P, 3). Returns (P, 16), ordered by degree l, then by order m = −l … l.
    The signs are those without the Condon–Shortley phase. The constants are
    √((2l + 1)/4π · (l − |m|)!/(l + |m|)!), times √2 where m ≠ 0.
    """
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ],
        -1,
    )
