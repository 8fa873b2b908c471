"""Space divided into cells of which few may hold something: what a march steps through, and what it leaps over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

BLOCK = 4  # cells a side of a block, the unit of leaps
FARTHEST = 12  # blocks: longer leaps than so many save nothing


class CellArrays(NamedTuple):
    """What a march on a CPU reads: numpy views of `Cells`."""

    origin: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    leap: np.ndarray
    occupied: np.ndarray
    contracted: bool


@dataclass(frozen=True)
class Cells:
    """size: cells a side (x, y, z). origin, voxel: (3,) float64, the lower corner and a cell's sides, box coordinates.

    contracted: whether box coordinates are those of `nerf_core.geometry.spaces.contract`. occupied: (x, y, z) bool.
    leap: blocks of cells, uint8, 0 where a block has an occupied cell, else the distance in blocks to the nearest
    that has.
    """

    size: tuple[int, int, int]
    origin: np.ndarray
    voxel: np.ndarray
    contracted: bool
    occupied: Tensor
    leap: Tensor

    @staticmethod
    def of(origin: np.ndarray, voxel: np.ndarray, occupied: Tensor, contracted: bool) -> Cells:
        x, y, z = occupied.shape
        return Cells((x, y, z), origin, voxel, contracted, occupied, leaps(occupied))

    def cell_arrays(self) -> CellArrays:
        return CellArrays(
            self.origin.astype(np.float32), (1 / self.voxel).astype(np.float32), np.array(self.size, np.int64),
            self.leap.numpy().ravel(), self.occupied.view(torch.uint8).numpy().ravel(), self.contracted,
        )  # fmt: skip

    def cells_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Box coordinates (P, 3) → cell (P, 3) int64 and position within it (P, 3) in [0, 1]; outside: the border's."""
        origin = torch.from_numpy(self.origin).to(x)
        at = (x - origin) / torch.from_numpy(self.voxel).to(x)
        cell = at.floor().long().clamp(min=0).minimum(torch.tensor(self.size, device=x.device) - 1)
        return cell, (at - cell).clamp(0, 1)


def leaps(occupied: Tensor) -> Tensor:
    """Cells (x, y, z) bool → per block of 4³ cells how many blocks away the nearest occupied one is, uint8."""
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
    """Cells (x, y, z) bool and their neighbours, those at the edges and corners too."""
    for axis in range(3):
        grown = cells.clone()
        n = cells.shape[axis]
        grown.narrow(axis, 1, n - 1).logical_or_(cells.narrow(axis, 0, n - 1))
        grown.narrow(axis, 0, n - 1).logical_or_(cells.narrow(axis, 1, n - 1))
        cells = grown
    return cells


def blocks(whole: Tensor) -> Tensor:
    """(4x, 4y, 4z) bool → (x, y, z): whether anything is in the block."""
    x, y, z = (n // BLOCK for n in whole.shape)
    return whole.view(x, BLOCK, y, BLOCK, z, BLOCK).any(5).any(3).any(1)
