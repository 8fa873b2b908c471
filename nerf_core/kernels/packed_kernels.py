"""What a device must be able to do with packed samples and a hash grid: one interface, several implementations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.cells import Cells
from nerf_core.volume.packed import Packed

PRIMES = (1, 2654435761, 805459861)  # of the spatial hash: instant-ngp, Eq. 4 (arXiv:2201.05989)


@dataclass(frozen=True)
class Samples(Packed):
    """x: (M, 3) in [0, 1], within the cells' box."""

    x: Tensor

    def at(self, index: Tensor) -> Samples:
        """Those of an ascending index (K,)."""
        ends = torch.searchsorted(index, self.ends)
        return Samples(ends, self.t[index], self.width[index], self.x[index])

    def fitted(self, room: int) -> Samples:
        """Exactly `room` samples: what does not fit is cut off, what is missing lies behind the last ray, all zero."""
        missing = room - len(self.t)  # negative: cut off
        ends = self.ends.clamp(max=room)
        t, width = (functional.pad(v, (0, missing)) for v in (self.t, self.width))
        return Samples(ends, t, width, functional.pad(self.x, (0, 0, 0, missing)))


class HashLevels(NamedTuple):
    """resolutions: cells a side of each of L levels; a level with more vertices than the table has rows is hashed."""

    resolutions: tuple[int, ...]

    def dense(self, level: int, rows: int) -> bool:
        return (self.resolutions[level] + 1) ** 3 <= rows


class PackedKernels(Protocol):
    """name: of the implementation. fixed_shapes: training is fastest if the number of rays and samples in a step never
    changes, because the step is then recorded once and replayed (CUDA graphs)."""

    name: str
    fixed_shapes: bool

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor, room: int = 0) -> Samples:
        """Samples `step` cells apart in occupied cells; offsets (R,): where the first lies in its step.

        room: give `Samples.fitted` to so many, so that shapes never change.
        """
        ...

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        """Table (L, T, F), x (M, 3) in [0, 1] → trilinear features (M, L · F): instant-ngp, section 3."""
        ...

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        """Add the gradient (M, L · F) of the features to that of the table, `into` (L, T, F)."""
        ...

    def composite(self, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor) -> Tensor:
        """Optical depths (M,), colours (M, 3) → (R, 5) colour over the background, opacity, Σ w t: NeRF Eq. 3."""
        ...

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The gradient (R, 3) of the colours → those of tau (M,) and rgb (M, 3)."""
        ...

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], numbers: Tensor) -> None:
        """Adam on the rows whose gradient is not zero, which is then cleared; numbers: see `adam_numbers`."""
        ...


BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # instant-ngp's, section 4


def adam_numbers(rate: float, step: int) -> Tensor:
    """(3,) learning rate, 1/(1 − β₁ᵗ), 1/(1 − β₂ᵗ)."""
    return torch.tensor([rate, 1 / (1 - BETA1**step), 1 / (1 - BETA2**step)])
