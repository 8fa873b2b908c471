"""A multiresolution hash grid and two small networks: (x, d) → σ, rgb (Müller et al. 2022, arXiv:2201.05989)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nerf_core.kernels.packed_kernels import HashLevels, PackedKernels
from nerf_core.volume.encodings import spherical_harmonics

FEATURES = 16  # outputs of the density network; the first is the raw density
DIRECTIONS = 16  # spherical harmonics up to degree 3


class HashField(nn.Module):
    """The field (x, d) → (raw density, colour).

    table: (L, T, F) features.
    density: a network from L · F features to 16 outputs; the first is the raw density.
    color: a network from those 16 and the spherical harmonics of d to 3 channels.
    """

    def __init__(self, levels: HashLevels, rows: int, width: int, hidden: int, kernels: PackedKernels) -> None:
        super().__init__()
        self.levels, self.kernels = levels, kernels
        count = len(levels.resolutions)
        self.table = nn.Parameter(torch.zeros(count, rows, width))
        into = FEATURES + DIRECTIONS
        self.density = nn.Sequential(nn.Linear(count * width, hidden), _relu(), nn.Linear(hidden, FEATURES))
        self.color = nn.Sequential(
            nn.Linear(into, hidden), _relu(), nn.Linear(hidden, hidden), _relu(), nn.Linear(hidden, 3)
        )

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Initialise the table uniformly in ±1e-4, as in the paper, and the layers like torch."""
        self.table.uniform_(-1e-4, 1e-4, generator=generator)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                bound = 1 / math.sqrt(layer.in_features)
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.uniform_(-bound, bound, generator=generator)

    def networks(self) -> list[Tensor]:
        return [p for name, p in self.named_parameters() if name != "table"]

    def encode(self, x: Tensor) -> Tensor:
        """Return features (M, L · F) at x (M, 3) in [0, 1]. It builds no graph; `encode_gradient` is its backward."""
        return self.kernels.encode(self.table.detach(), self.levels, x)

    def geometry(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (M,) and the vectors (M, 16) for the colour network."""
        out = self.density(features)
        return out[:, 0], out

    def radiance(self, geometry: Tensor, d: Tensor) -> Tensor:
        """Return colours (M, 3) in [0, 1] for unit directions (M, 3)."""
        return torch.sigmoid(self.color(torch.cat([geometry, spherical_harmonics(d)], -1)))

    def colors(self, geometry: Tensor, d: Tensor) -> Tensor:
        """Return `radiance` of every vector (P, 16) in every unit direction (D, 3), as (P, D, 3).

        The first layer is linear before its ReLU, so that the parts of its two inputs are computed once and added.
        """
        first, others = self.color[0], self.color[1:]
        assert isinstance(first, nn.Linear)
        of_points, of_directions = first.weight.split([FEATURES, DIRECTIONS], 1)
        seen = nn.functional.linear(spherical_harmonics(d), of_directions, first.bias)
        return others(nn.functional.linear(geometry, of_points)[:, None] + seen).sigmoid_()


def _relu() -> nn.Module:
    """A ReLU in place, because such narrow layers are limited by memory bandwidth."""
    return nn.ReLU(inplace=True)
