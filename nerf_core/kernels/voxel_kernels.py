"""What a device must be able to do with a voxel grid: one interface, several implementations of the same maths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.packed import Packed
from nerf_core.volume.voxel_grid import VoxelGrid


@dataclass(frozen=True)
class March:
    """How rays are sampled. step: length of a sample, in cells; density is per cell, so α = 1 − exp(−σ · step).

    offsets: (R,) where the first sample lies in its step, 0 … 1. bias: added to the raw density before softplus.
    background: (3,). smoothness: weight of ½ Σ (σ_k − mean)² over the 8 corners' raw densities of every sample.
    """

    step: float
    bias: float
    background: Tensor
    offsets: Tensor
    smoothness: float = 0.0
    threshold: float = 1.0


class Adam(NamedTuple):
    """rate_*: learning rates. keep, keep_square: β₁, β₂; warm, warm_square: 1/(1 − βᵗ). epsilon: in units of a ray's
    gradient. follow: the share of the way that the rows' average goes towards them."""

    rate_color: float
    rate_density: float
    keep: float
    keep_square: float
    warm: float
    warm_square: float
    epsilon: float
    follow: float


@dataclass(frozen=True)
class Traced(Packed):
    """The samples that made R pixels (R, 5), as `render` has them: raw density with its bias, α, T (M,), rgb (M, 3)."""

    raw: Tensor
    alpha: Tensor
    light: Tensor
    rgb: Tensor
    pixel: Tensor


class VoxelKernels(Protocol):
    """Gradients add up inside until `update` applies or `forget` drops them."""

    name: str

    def render(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Tensor:
        """(R, 5): colour over the background, opacity, Σ w t."""
        ...

    def trace(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Traced:
        """`render` with what it composited kept."""
        ...

    def resample(self, old: VoxelGrid, new: VoxelGrid, first: int, last: int) -> None:
        """Interpolate `old` at the vertices of bricks first ≤ b < last of `new`; what it does not store counts as 0."""
        ...

    def accumulate(self, grid: VoxelGrid, rays: BoxRays, truth: Tensor, how: March) -> tuple[float, int]:
        """Add the gradient of ½ Σ squared error (and of smoothness); returns Σ squared error and the samples used."""
        ...

    def forget(self) -> None: ...

    def gradient(self, grid: VoxelGrid) -> Tensor:
        """What has been added up, (M, 16)."""
        ...

    def seen(self, grid: VoxelGrid) -> Tensor:
        """(M,) bool, at each cell's lowest vertex: whether since `see` a sample in it weighed more than `threshold`."""
        ...

    def see(self, grid: VoxelGrid, seen: Tensor) -> None:
        """Set what `seen` returns."""
        ...

    def update(self, grid: VoxelGrid, moments: Tensor, average: Tensor, adam: Adam) -> None:
        """One step of Adam on the rows that have a gradient, which is then forgotten; `average` (M, 16) follows."""
        ...
