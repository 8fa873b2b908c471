"""A dense grid of opacity and colour: the law of its opacities, its interpolation, its empty cells.

A vertex stores four numbers, the logits of red, green, blue and of an opacity α, so that an optimiser may move them
freely. Logits are interpolated trilinearly within a cell; then the sigmoid gives colour and α in (0, 1). Interpolating
before the sigmoid lets a surface lie anywhere inside a cell, and sharply (DVGO, arXiv:2111.11215, section 4.2).

α belongs to one length, that of a cell, h. Of light that crosses it the share 1 − α is left; so a stretch δ leaves the
share (1 − α)^(δ/h), and its opacity is

    α_δ = 1 − (1 − α)^(δ/h).

Two stretches one after the other then absorb just what both together do. It is the law of a constant density
σ = −ln(1 − α)/h (NeRF Eq. 3, arXiv:2003.08934). With the logit s of α, −ln(1 − α) = ln(1 + eˢ) = softplus(s).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.spaces import BoxRays, Space
from nerf_core.kernels.packed_kernels import HashLevels, PackedKernels
from nerf_core.volume.cells import Cells

CHANNELS = 4
RGB, ALPHA = slice(0, 3), 3
SLAB = 1 << 19  # vertices between two calls of the yield callback: about 10 ms


def optical_depth(logit: Tensor, cells: Tensor | float) -> Tensor:
    """Return σ δ of a stretch of δ = `cells` · h: −ln(1 − α) · δ/h, with α = sigmoid(logit)."""
    return functional.softplus(logit) * cells


def opacity(logit: Tensor, cells: Tensor | float) -> Tensor:
    """Return α_δ = 1 − (1 − α)^(δ/h) of a stretch of δ = `cells` · h."""
    return -torch.expm1(-optical_depth(logit, cells))


def logit_of(depth: Tensor) -> Tensor:
    """Return the logit of the opacity 1 − e^−depth: the inverse of `optical_depth` of one cell.

    The logit is ln(e^depth − 1), written so that a large depth does not overflow. A depth that rounding made 0 counts
    as float32's smallest number, because the logarithm of 0 is infinite.
    """
    depth = depth.clamp(min=torch.finfo(torch.float32).tiny)
    return depth + torch.log(-torch.expm1(-depth))


@dataclass(frozen=True)
class RgbaVolume:
    """N × N × N vertices over the box of a space, the outermost on its faces.

    logits: (N, N, N, 4) float32, contiguous: 16 N³ bytes. Axes: x, y, z, then red, green, blue, α.
    space: the box. Under NDC it is no cube, and so neither are the cells.
    """

    logits: Tensor
    space: Space

    @staticmethod
    def fog(side: int, alpha: float, space: Space, device: torch.device) -> RgbaVolume:
        """Grey fog of one opacity."""
        logits = torch.zeros(side, side, side, CHANNELS, device=device)
        logits[..., ALPHA] = torch.logit(torch.tensor(alpha))
        return RgbaVolume(logits, space)

    @property
    def side(self) -> int:
        return self.logits.shape[0]

    @property
    def voxel(self) -> np.ndarray:
        """The sides of a cell in box coordinates, (3,) float64."""
        return (self.space.high - self.space.low) / (self.side - 1)

    @property
    def cell(self) -> float:
        """The length h in box coordinates: the geometric mean of a cell's sides, which are equal except under NDC."""
        return float(np.prod(self.voxel) ** (1 / 3))

    @property
    def table(self) -> Tensor:
        """The vertices as the kernels want them: one level of a table, (1, N³, 4)."""
        return self.logits.view(1, -1, CHANNELS)

    @property
    def levels(self) -> HashLevels:
        return HashLevels((self.side - 1,))

    def at(self, kernels: PackedKernels, x: Tensor) -> Tensor:
        """Interpolate trilinearly: x (M, 3) in [0, 1] of the box → logits (M, 4)."""
        return kernels.encode(self.table, self.levels, x)

    def unit(self, points: Tensor) -> Tensor:
        """Map world points (P, 3) to [0, 1] of the box; points outside come onto its faces."""
        box = self.space.points(points)
        low, high = (torch.from_numpy(v).to(box) for v in (self.space.low, self.space.high))
        return ((box - low) / (high - low)).clamp(0, 1)

    def cells_crossed(self, boxed: BoxRays, step: float) -> Tensor:
        """Return δ/h (R,) of samples that lie `step` cells apart: `step` itself, unless cells are no cubes.

        Then the march counts cells of each axis apart, and a step's length depends on the ray's direction.
        """
        d, voxel = boxed.directions, torch.from_numpy(self.voxel).to(boxed.directions)
        return step * d.norm(dim=-1) / ((d / voxel).norm(dim=-1) * self.cell)

    # ---- empty space ------------------------------------------------------------------------------------------------

    def everything(self) -> Tensor:
        """All cells as occupied: (N − 1, N − 1, N − 1) bool."""
        return torch.ones(*[self.side - 1] * 3, dtype=torch.bool, device=self.logits.device)

    def cells(self, occupied: Tensor) -> Cells:
        """Cells of which `occupied` (N − 1, N − 1, N − 1) says where rays take samples."""
        return Cells.of(self.space.low, self.voxel, occupied, self.space.kind == "contracted")

    def occupied(self, empty: float, yield_callback: Callable[[], None]) -> Tensor:
        """Find the cells whose most opaque corner has an opacity above `empty`: (N − 1, N − 1, N − 1) bool.

        No point of a cell is more opaque than its corners. While the whole grid is thin fog, the mean over all cells
        counts instead, if it is lower (as in instant-ngp, appendix C, arXiv:2201.05989). If nothing is opaque, all
        cells are occupied, so that they can learn.
        """
        n, most, total = self.side, [], 0.0
        for first, last in slabs(n - 1, n):
            a = self.logits[first : last + 1, :, :, ALPHA]
            for axis in range(3):
                a = torch.maximum(a.narrow(axis, 0, a.shape[axis] - 1), a.narrow(axis, 1, a.shape[axis] - 1))
            most.append(torch.sigmoid(a))
            total += float(most[-1].sum())
            yield_callback()
        least = min(empty, total / (n - 1) ** 3)
        found = self.everything()
        for (first, last), a in zip(slabs(n - 1, n), most, strict=True):
            torch.gt(a, least, out=found[first:last])
            yield_callback()
        return found if bool(found.any()) else self.everything()

    # ---- finer ------------------------------------------------------------------------------------------------------

    def refined(self, kernels: PackedKernels, side: int, yield_callback: Callable[[], None]) -> RgbaVolume:
        """Return the same field on `side` vertices a side.

        The cells become shorter, and each α becomes the opacity of the shorter length.
        """
        device, ratio = self.logits.device, (self.side - 1) / (side - 1)
        logits = torch.empty(side, side, side, CHANNELS, device=device)
        place = torch.linspace(0, 1, side, device=device)
        for first, last in slabs(side, side):
            x = torch.cartesian_prod(place[first:last], place, place)
            part = self.at(kernels, x)
            part[:, ALPHA] = logit_of(optical_depth(part[:, ALPHA], ratio))
            logits[first:last] = part.view(last - first, side, side, CHANNELS)
            yield_callback()
        return RgbaVolume(logits, self.space)


def zeros_like(logits: Tensor, yield_callback: Callable[[], None]) -> Tensor:
    """Return zeros in the shape of (N, N, N, 4), written slab by slab: the system hands out new memory slowly."""
    new = torch.empty_like(logits)
    for first, last in slabs(*logits.shape[:2]):
        new[first:last] = 0
        yield_callback()
    return new


def slabs(planes: int, side: int) -> Iterator[tuple[int, int]]:
    """Divide `planes` planes of side² vertices into ranges [first, last) of about SLAB vertices."""
    thick = max(1, SLAB // side**2)
    for first in range(0, planes, thick):
        yield first, min(first + thick, planes)


def corners_of(occupied: Tensor, yield_callback: Callable[[], None]) -> Tensor:
    """Return the vertices of occupied cells: (N − 1, N − 1, N − 1) bool → rows of the table (K,) int64, ascending."""
    n, found = occupied.shape[0] + 1, []
    for first, last in slabs(n, n):
        cells = occupied[max(first - 1, 0) : last]  # those on both sides of the planes
        near = functional.pad(cells, (1, 1, 1, 1, int(first == 0), int(last == n)))
        for axis in range(3):
            near = near.narrow(axis, 0, near.shape[axis] - 1) | near.narrow(axis, 1, near.shape[axis] - 1)
        found.append(near.flatten().nonzero()[:, 0] + first * n * n)
        yield_callback()
    return torch.cat(found)


def neighbours_of(rows: Tensor, side: int) -> Tensor:
    """Return the rows of the six neighbours of vertices: (K,) → (K, 6) int64.

    Beyond a face of the box a vertex is its own neighbour.
    """
    found = []
    for stride in (side * side, side, 1):
        at = torch.div(rows, stride, rounding_mode="floor") % side
        found += [torch.where(at > 0, rows - stride, rows), torch.where(at < side - 1, rows + stride, rows)]
    return torch.stack(found, 1)


def roughness(logits: Tensor, rows: Tensor, neighbours: Tensor) -> Tensor:
    """Return the gradient of half the squared differences between neighbouring vertices: at `rows` (K,), (K, 4).

    For a vertex it is the sum over its neighbours of its own value minus theirs: a discrete −∇².
    logits: (N, N, N, 4). neighbours: (K, 6), those of `rows`.
    """
    values = logits.view(-1, CHANNELS)
    # the bag of an embedding is the sum of rows: here it takes half the time of six gathers
    bags = torch.arange(0, neighbours.numel(), neighbours.shape[1], device=neighbours.device)
    return 6 * values.index_select(0, rows) - functional.embedding_bag(neighbours.flatten(), values, bags, mode="sum")
