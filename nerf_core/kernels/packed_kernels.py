"""What a device must be able to do with packed samples and a hash grid: one interface, several implementations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from nerf_core.cells import Cells
from nerf_core.spaces import BoxRays

PRIMES = (1, 2654435761, 805459861)  # of the spatial hash: instant-ngp, Eq. 4 (arXiv:2201.05989)


@dataclass(frozen=True)
class Samples:
    """M samples, ray after ray, front to back. ends: (R + 1,) int64, where each ray's samples begin, and M.

    x: (M, 3) in [0, 1], within the cells' box. t, width: (M,) of the box rays' parameter.
    """

    ends: Tensor
    x: Tensor
    t: Tensor
    width: Tensor

    @property
    def ray(self) -> Tensor:
        """(M,) the ray of each sample."""
        counts = self.ends.diff()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)

    def at(self, index: Tensor) -> Samples:
        """Those of an ascending index (K,)."""
        ends = torch.searchsorted(index, self.ends)
        return Samples(ends, self.x[index], self.t[index], self.width[index])


class HashLevels(NamedTuple):
    """resolutions: cells a side of each of L levels; a level with more vertices than the table has rows is hashed."""

    resolutions: tuple[int, ...]

    def dense(self, level: int, rows: int) -> bool:
        return (self.resolutions[level] + 1) ** 3 <= rows


class PackedKernels(Protocol):
    name: str

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor) -> Samples:
        """Samples `step` cells apart in occupied cells; offsets (R,): where the first lies in its step."""
        ...

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        """Table (L, T, F), x (M, 3) in [0, 1] → trilinear features (M, L · F): instant-ngp, section 3."""
        ...

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        """Add the gradient (M, L · F) of the features to that of the table, `into` (L, T, F)."""
        ...

    def composite(self, tau: Tensor, rgb: Tensor, samples: Samples, background: Tensor) -> Tensor:
        """Optical depths (M,), colours (M, 3) → (R, 5) colour over the background, opacity, Σ w t: NeRF Eq. 3."""
        ...

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Samples, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The gradient (R, 3) of the colours → those of tau (M,) and rgb (M, 3)."""
        ...

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rate: float, step: int) -> None:
        """Adam on the entries whose gradient is not zero, which is then cleared; β₁ 0.9, β₂ 0.99, ε 1e-15."""
        ...


BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # instant-ngp's, section 4
