"""Rows of parameters at the vertices of the cells that may hold something; empty space has none.

Vertices are stored in bricks of 4 × 4 × 4, z fastest, one row of 16 float32 each: 3 × 4 spherical-harmonic coefficients
of colour, the raw density, and padding to one cache line. `table` says which brick is stored where.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

BRICK = 4  # vertices, and cells of a block, a side
ROWS = BRICK**3
WIDTH = 16  # floats of a row
DENSITY = 12  # where a row's raw density lies
FARTHEST = 12  # blocks: longer leaps than so many save nothing
CHUNK = 1 << 18  # vertices resampled at once


class GridArrays(NamedTuple):
    """What the kernels read: numpy views of a `VoxelGrid`."""

    origin: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    table: np.ndarray
    leap: np.ndarray
    occupied: np.ndarray
    contracted: bool


@dataclass(frozen=True)
class VoxelGrid:
    """size: cells a side (x, y, z). origin, voxel: (3,) float64, the lower corner and a cell's sides, box coordinates.

    occupied: (x, y, z) bool. table: bricks of vertices (bx, by, bz) int32, −1 where none is stored. leap: blocks of
    cells, uint8, 0 where a block has an occupied cell, else the distance in blocks to the nearest that has.
    rows: (M, 16) float32.
    """

    size: tuple[int, int, int]
    origin: np.ndarray
    voxel: np.ndarray
    contracted: bool
    occupied: Tensor
    table: Tensor
    leap: Tensor
    rows: Tensor

    @staticmethod
    def over(origin: np.ndarray, voxel: np.ndarray, occupied: Tensor, contracted: bool) -> VoxelGrid:
        """A grid of zeros for these cells."""
        size = occupied.shape
        bricks = bricks_of(occupied)
        table = torch.full(bricks.shape, -1, dtype=torch.int32, device=occupied.device)
        count = int(bricks.sum())
        table[bricks] = torch.arange(count, dtype=torch.int32, device=occupied.device)
        rows = torch.zeros(count * ROWS, WIDTH, device=occupied.device)
        return VoxelGrid((size[0], size[1], size[2]), origin, voxel, contracted, occupied, table, leaps(occupied), rows)

    def arrays(self) -> GridArrays:
        return GridArrays(
            self.origin.astype(np.float32), (1 / self.voxel).astype(np.float32), np.array(self.size, np.int64),
            self.table.numpy().ravel(), self.leap.numpy().ravel(), self.occupied.view(torch.uint8).numpy().ravel(),
            self.contracted,
        )  # fmt: skip

    @property
    def bricks(self) -> int:
        return len(self.rows) // ROWS

    def with_cells(self, occupied: Tensor) -> VoxelGrid:
        """The same rows with some cells fewer."""
        return replace(self, occupied=occupied, leap=leaps(occupied))

    def dense(self, values: Tensor) -> Tensor:
        """One value a row (M,) → one a vertex (x + 1, y + 1, z + 1), zero where none is stored."""
        bricks = torch.zeros(*self.table.shape, ROWS, dtype=values.dtype, device=values.device)
        bricks[self.table >= 0] = values.view(-1, ROWS)
        shape = [BRICK * n for n in self.table.shape]
        whole = bricks.view(*self.table.shape, BRICK, BRICK, BRICK).permute(0, 3, 1, 4, 2, 5).reshape(shape)
        x, y, z = self.size
        return whole[: x + 1, : y + 1, : z + 1]

    def vertices(self) -> Tensor:
        """(M, 3) int64: the vertex of each row."""
        brick = (self.table >= 0).nonzero()
        brick = brick[self.table[self.table >= 0].long().argsort()]
        inside = torch.stack(torch.meshgrid(*[torch.arange(BRICK, device=brick.device)] * 3, indexing="ij"), -1)
        return (BRICK * brick[:, None] + inside.reshape(-1, 3)).reshape(-1, 3)

    def row_of(self, vertex: Tensor) -> Tensor:
        """(P, 3) vertices → rows (P,), −1 where none is stored or outside."""
        most = BRICK * torch.tensor(self.table.shape, device=vertex.device)
        inside = ((vertex >= 0) & (vertex < most)).all(-1)
        v = torch.where(inside[:, None], vertex, 0)
        b = v // BRICK
        brick = self.table[b[:, 0], b[:, 1], b[:, 2]].long()
        local = v - BRICK * b
        row = brick * ROWS + local[:, 0] * BRICK * BRICK + local[:, 1] * BRICK + local[:, 2]
        return torch.where(inside & (brick >= 0), row, -1)

    def cells_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Box coordinates (P, 3) → cell (P, 3) int64 and position within it (P, 3) in [0, 1]; outside: the border's."""
        origin = torch.from_numpy(self.origin).to(x)
        at = (x - origin) / torch.from_numpy(self.voxel).to(x)
        cell = at.floor().long().clamp(min=0).minimum(torch.tensor(self.size, device=x.device) - 1)
        return cell, (at - cell).clamp(0, 1)

    def interpolate(self, cell: Tensor, within: Tensor) -> Tensor:
        """Trilinear rows (P, 16) in cells (P, 3) at `within` (P, 3); vertices that are not stored count as zero."""
        total = self.rows.new_zeros(len(cell), WIDTH)
        for corner in torch.cartesian_prod(*[torch.arange(2, device=cell.device)] * 3):
            weight = torch.where(corner == 1, within, 1 - within).prod(-1)
            row = self.row_of(cell + corner)
            weight = torch.where(row >= 0, weight, 0)
            total.addcmul_(weight[:, None].to(self.rows.dtype), self.rows[row.clamp(min=0)])
        return total

    def resampled(self, origin: np.ndarray, voxel: np.ndarray, occupied: Tensor) -> VoxelGrid:
        """A grid for `occupied` cells of another size, with this one's values interpolated at its vertices."""
        new = VoxelGrid.over(origin, voxel, occupied, self.contracted)
        vertices, size = new.vertices(), torch.from_numpy(voxel).to(self.rows)
        for start in range(0, len(vertices), CHUNK):
            part = vertices[start : start + CHUNK]
            x = torch.from_numpy(origin).to(self.rows) + part * size
            new.rows[start : start + CHUNK] = self.interpolate(*self.cells_of(x))
        return new

    def state(self) -> dict[str, Tensor]:
        return {
            "origin": torch.from_numpy(self.origin), "voxel": torch.from_numpy(self.voxel),
            "occupied": self.occupied, "bricks": self.table >= 0, "rows": self.rows,
        }  # fmt: skip

    @staticmethod
    def restored(state: Mapping[str, Tensor], contracted: bool) -> VoxelGrid:
        """The grid of `state()`. Raises ValueError where it is not whole: kernels trust table and cells blindly."""
        occupied, bricks, rows = state["occupied"], state["bricks"], state["rows"]
        origin, voxel = (state[name].numpy().astype(np.float64) for name in ("origin", "voxel"))
        sound = (
            occupied.dtype == bricks.dtype == torch.bool and occupied.ndim == bricks.ndim == 3
            and rows.dtype == torch.float32 and origin.shape == voxel.shape == (3,)
            and min(occupied.shape) > 0 and np.isfinite(origin).all() and (voxel > 0).all()
        )  # fmt: skip
        if not sound:
            raise ValueError("the voxel grid is not of the kind that is written")
        grid = VoxelGrid.over(origin, voxel, occupied, contracted)
        if grid.table.shape != bricks.shape or bool(((grid.table >= 0) & ~bricks).any()):
            raise ValueError("the voxel grid lacks rows for its cells")
        if rows.shape != (int(bricks.sum()) * ROWS, WIDTH):
            raise ValueError("the voxel grid's rows do not fit its bricks")
        table = torch.full(bricks.shape, -1, dtype=torch.int32)
        table[bricks] = torch.arange(int(bricks.sum()), dtype=torch.int32)
        return replace(grid, table=table, rows=torch.empty_like(rows).copy_(rows))


def leaps(occupied: Tensor) -> Tensor:
    """Cells (x, y, z) bool → per block of 4³ cells how many blocks away the nearest occupied one is, uint8."""
    padded = torch.zeros([BRICK * -(-n // BRICK) for n in occupied.shape], dtype=torch.bool, device=occupied.device)
    padded[: occupied.shape[0], : occupied.shape[1], : occupied.shape[2]] = occupied
    reached = _blocks(padded)
    distance = torch.where(reached, 0, FARTHEST).to(torch.uint8)
    for d in range(1, FARTHEST):
        grown = grow(reached)
        distance[grown & ~reached] = d
        reached = grown
    return distance


def bricks_of(occupied: Tensor) -> Tensor:
    """Cells (x, y, z) bool → the bricks (bx, by, bz) bool that hold their vertices."""
    x, y, z = occupied.shape
    vertices = torch.zeros([BRICK * (n // BRICK + 1) for n in (x, y, z)], dtype=torch.bool, device=occupied.device)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                vertices[a : a + x, b : b + y, c : c + z] |= occupied
    return _blocks(vertices)


def grow(cells: Tensor) -> Tensor:
    """Cells (x, y, z) bool and their neighbours, those at the edges and corners too."""
    for axis in range(3):
        grown = cells.clone()
        n = cells.shape[axis]
        grown.narrow(axis, 1, n - 1).logical_or_(cells.narrow(axis, 0, n - 1))
        grown.narrow(axis, 0, n - 1).logical_or_(cells.narrow(axis, 1, n - 1))
        cells = grown
    return cells


def cells_between(vertices: Tensor) -> Tensor:
    """Vertices (x + 1, y + 1, z + 1) bool → cells (x, y, z) with one of them."""
    for axis in range(3):
        n = vertices.shape[axis]
        vertices = vertices.narrow(axis, 1, n - 1) | vertices.narrow(axis, 0, n - 1)
    return vertices


def _blocks(whole: Tensor) -> Tensor:
    """(4x, 4y, 4z) bool → (x, y, z): whether anything is in the block."""
    x, y, z = (n // BRICK for n in whole.shape)
    return whole.view(x, BRICK, y, BRICK, z, BRICK).any(5).any(3).any(1)
