"""The interface of the kernels for packed samples and a hash grid. Every device has an implementation of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.cells import Cells
from nerf_core.volume.packed import Packed

PRIMES = (1, 2654435761, 805459861)  # factors of the spatial hash: instant-ngp, Eq. 4 (arXiv:2201.05989)


@dataclass(frozen=True)
class BoxSamples(Packed):
    """Packed samples with their positions. x: (M, 3) in [0, 1], relative to the cells' box."""

    x: Tensor

    def at(self, index: Tensor) -> BoxSamples:
        """The samples at an ascending index (K,)."""
        row_offsets = torch.searchsorted(index, self.row_offsets)
        return BoxSamples(row_offsets, self.t[index], self.width[index], self.x[index])

    def fitted(self, capacity: int) -> BoxSamples:
        """Exactly `capacity` samples. Surplus samples are cut off; missing ones are zeros behind the last ray."""
        missing = capacity - len(self.t)  # negative: cut off
        row_offsets = self.row_offsets.clamp(max=capacity)
        t, width = (functional.pad(v, (0, missing)) for v in (self.t, self.width))
        return BoxSamples(row_offsets, t, width, functional.pad(self.x, (0, 0, 0, missing)))


class HashLevels(NamedTuple):
    """The levels of a hash grid.

    resolutions: cells a side of each of the L levels. A level with more vertices than the table has rows is hashed.
    """

    resolutions: tuple[int, ...]

    def dense(self, level: int, rows: int) -> bool:
        """Whether each vertex of a level has its own row in a table of so many rows."""
        return (self.resolutions[level] + 1) ** 3 <= rows


class PackedKernels(Protocol):
    """The operations. Arrays are on the device of the implementation.

    name: the implementation's. fixed_shapes: training is fastest if the number of rays and samples in a step never
    changes, because the step is then recorded once and replayed (CUDA graphs).
    """

    name: str
    fixed_shapes: bool

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor, capacity: int = 0) -> BoxSamples:
        """Place samples `step` cells apart in the occupied cells.

        offsets: (R,), where each ray's first sample lies in its step, 0 … 1.
        capacity: fit the samples to this number, so that shapes never change (`BoxSamples.fitted`); 0: do not.
        """
        ...

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        """Interpolate features trilinearly on every level: instant-ngp, section 3.

        table: (L, T, F). x: (M, 3) in [0, 1]. Returns (M, L · F).
        """
        ...

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        """Add the gradient that the features' gradient (M, L · F) causes to the table's, `into` (L, T, F)."""
        ...

    def composite(self, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor) -> Tensor:
        """Composite packed samples: NeRF Eq. 3.

        tau: optical depths (M,). rgb: (M, 3). background: (3,).
        Returns (R, 5): colour over the background, opacity, Σ w t.
        """
        ...

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The gradients of tau (M,) and rgb (M, 3), from the gradient (R, 3) of the pixels' colours."""
        ...

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], numbers: Tensor) -> None:
        """One step of Adam on the rows that have a gradient; the gradient is then cleared.

        numbers: what `adam_numbers` returns. moments: first and second, each (L, T, F).
        """
        ...


BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # instant-ngp's, section 4


def adam_numbers(rate: float, step: int) -> Tensor:
    """What changes from step to step: (3,) learning rate, 1/(1 − β₁ᵗ), 1/(1 − β₂ᵗ) with t = step."""
    return torch.tensor([rate, 1 / (1 - BETA1**step), 1 / (1 - BETA2**step)])
