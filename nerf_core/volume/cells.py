"""A grid of cells, occupied or empty. A march along a ray steps through occupied cells and leaps over empty ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

BLOCK = 4  # cells a side of a block, the unit of leaps
FARTHEST = 12  # blocks of the longest leap: longer ones save no time


class CellArrays(NamedTuple):
    """Numpy views of `Cells`, for a march on a CPU."""

    origin: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    leap: np.ndarray
    kinds: np.ndarray
    contracted: bool


@dataclass(frozen=True)
class Cells:
    """A box of cells, and how far a march may leap from each block of them.

    size: number of cells along x, y and z.
    origin: (3,) float64, the box's lower corner. voxel: (3,) float64, a cell's sides. Both in box coordinates.
    contracted: whether box coordinates are those of `nerf_core.geometry.spaces.contract`.
    kinds: (x, y, z) uint8, 0 where a cell is empty and 1 where it is occupied; see also `VoxelGrid`.
    leap: uint8 for each block of BLOCK³ cells, the distance in blocks to the nearest block with an occupied cell; 0 if
        the block has one itself.
    """

    size: tuple[int, int, int]
    origin: np.ndarray
    voxel: np.ndarray
    contracted: bool
    kinds: Tensor
    leap: Tensor

    @staticmethod
    def of(origin: np.ndarray, voxel: np.ndarray, occupied: Tensor, contracted: bool) -> Cells:
        """Cells with the leaps that `occupied` (x, y, z) bool allows; for the other arguments see the class."""
        x, y, z = occupied.shape
        return Cells((x, y, z), origin, voxel, contracted, occupied.to(torch.uint8), leaps(occupied))

    @property
    def occupied(self) -> Tensor:
        """Which cells are occupied, (x, y, z) bool: a new tensor."""
        return self.kinds > 0

    def cell_arrays(self) -> CellArrays:
        """The arrays that the CPU kernels read."""
        return CellArrays(
            self.origin.astype(np.float32), (1 / self.voxel).astype(np.float32), np.array(self.size, np.int64),
            self.leap.numpy().ravel(), self.kinds.numpy().ravel(), self.contracted,
        )  # fmt: skip

    def doublings_of(self, cell: Tensor) -> Tensor:
        """Return how often the side of each occupied cell was doubled: (P, 3) int64 → (P,) int64, here 0."""
        return torch.zeros_like(cell[:, 0])

    def cells_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Find the cells of points.

        x: (P, 3) box coordinates. A point outside of the box gets the nearest cell at the border.
        Returns the cells (P, 3) int64, and the positions within them (P, 3) in [0, 1].
        """
        origin = torch.from_numpy(self.origin).to(x)
        at = (x - origin) / torch.from_numpy(self.voxel).to(x)
        cell = at.floor().long().clamp(min=0).minimum(torch.tensor(self.size, device=x.device) - 1)
        return cell, (at - cell).clamp(0, 1)


def leaps(occupied: Tensor) -> Tensor:
    """The distance in blocks from each block of 4³ cells to the nearest occupied one.

    occupied: (x, y, z) bool. Returns uint8 of one value a block, at most FARTHEST.
    """
    padded = torch.zeros([BLOCK * -(-n // BLOCK) for n in occupied.shape], dtype=torch.bool, device=occupied.device)
    padded[: occupied.shape[0], : occupied.shape[1], : occupied.shape[2]] = occupied
    reached = blocks(padded)
    distance = torch.where(reached, 0, FARTHEST).to(torch.uint8)
    for d in range(1, FARTHEST):
        grown = grow(reached)
        distance[grown & ~reached] = d
        reached = grown
    return distance


def grow(cells: Tensor) -> Tensor:
    """The greatest of each cell and its 26 neighbours, (x, y, z); of bool: whether any of them is set."""
    for axis in range(3):
        grown = cells.clone()
        n = cells.shape[axis]
        for ours, theirs in ((1, 0), (0, 1)):
            part = grown.narrow(axis, ours, n - 1)
            torch.maximum(part, cells.narrow(axis, theirs, n - 1), out=part)
        cells = grown
    return cells


def blocks(whole: Tensor) -> Tensor:
    """Whether any cell of a block is set: (4x, 4y, 4z) bool → (x, y, z) bool."""
    x, y, z = (n // BLOCK for n in whole.shape)
    return whole.view(x, BLOCK, y, BLOCK, z, BLOCK).any(5).any(3).any(1)
