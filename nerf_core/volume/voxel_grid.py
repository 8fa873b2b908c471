"""A sparse grid of parameters: one row for each vertex of an occupied cell, none in empty space.

Vertices are stored in bricks of 4 × 4 × 4, z fastest. A row has 16 float32: 3 × 4 spherical-harmonic coefficients of
colour, the raw density, and padding to one cache line. `table` says where each brick is stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.volume.cells import Cells, blocks, leaps

BRICK = 4  # vertices a side
ROWS = BRICK**3
WIDTH = 16  # floats of a row
DENSITY = 12  # where a row's raw density lies
# 1/√4π and √(3/4π), as in `encodings.spherical_harmonics`, but rounded: as a float32, SH0 differs from the exact value
# by one unit in the last place, and another value would change the weights that a seed gives.
SH0, SH1 = 0.28209479, 0.48860251


class GridArrays(NamedTuple):
    """Numpy views of a `VoxelGrid`, for the kernels: the fields of `CellArrays`, and `table`."""

    origin: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    leap: np.ndarray
    occupied: np.ndarray
    contracted: bool
    table: np.ndarray


@dataclass(frozen=True)
class VoxelGrid(Cells):
    """Cells with parameters at their vertices.

    table: (bx, by, bz) int32, the number of each brick in `rows`, −1 where none is stored.
    rows: (64 · bricks, 16) float32, brick after brick.
    """

    table: Tensor
    rows: Tensor

    @staticmethod
    def over(origin: np.ndarray, voxel: np.ndarray, occupied: Tensor, contracted: bool) -> VoxelGrid:
        """A grid of zeros with bricks for all occupied cells; for the arguments see `Cells`."""
        bricks = bricks_of(occupied)
        table = torch.full(bricks.shape, -1, dtype=torch.int32, device=occupied.device)
        count = int(bricks.sum())
        table[bricks] = torch.arange(count, dtype=torch.int32, device=occupied.device)
        rows = torch.zeros(count * ROWS, WIDTH, device=occupied.device)
        x, y, z = occupied.shape
        return VoxelGrid((x, y, z), origin, voxel, contracted, occupied, leaps(occupied), table, rows)

    def arrays(self) -> GridArrays:
        """The arrays that the CPU kernels read."""
        return GridArrays(*self.cell_arrays(), self.table.numpy().ravel())

    @property
    def bricks(self) -> int:
        """Number of bricks that are stored."""
        return len(self.rows) // ROWS

    def with_cells(self, occupied: Tensor) -> VoxelGrid:
        """The same rows, with fewer occupied cells."""
        return replace(self, occupied=occupied, leap=leaps(occupied))

    def dense(self, values: Tensor) -> Tensor:
        """Spread one value a row (M,) over the whole grid: (x + 1, y + 1, z + 1), zero where no row is stored."""
        bricks = torch.zeros(*self.table.shape, ROWS, dtype=values.dtype, device=values.device)
        bricks[self.table >= 0] = values.view(-1, ROWS)
        shape = [BRICK * n for n in self.table.shape]
        whole = bricks.view(*self.table.shape, BRICK, BRICK, BRICK).permute(0, 3, 1, 4, 2, 5).reshape(shape)
        x, y, z = self.size
        return whole[: x + 1, : y + 1, : z + 1]

    def places(self) -> Tensor:
        """Where the bricks lie in the table, in the order of their rows: (bricks, 3) int64."""
        return (self.table >= 0).nonzero().contiguous()  # nonzero returns it column by column

    def row_of(self, vertex: Tensor) -> Tensor:
        """The rows of vertices: (P, 3) int64 → (P,) int64, −1 outside of the grid and where no row is stored."""
        most = BRICK * torch.tensor(self.table.shape, device=vertex.device)
        inside = ((vertex >= 0) & (vertex < most)).all(-1)
        v = torch.where(inside[:, None], vertex, 0)
        b = v // BRICK
        brick = self.table[b[:, 0], b[:, 1], b[:, 2]].long()
        local = v - BRICK * b
        row = brick * ROWS + local[:, 0] * BRICK * BRICK + local[:, 1] * BRICK + local[:, 2]
        return torch.where(inside & (brick >= 0), row, -1)

    def interpolate(self, cell: Tensor, within: Tensor) -> Tensor:
        """Interpolate rows trilinearly. Vertices without a row count as zero.

        cell: (P, 3) int64. within: (P, 3) in [0, 1], the position in the cell. Returns (P, 16).
        """
        corners = torch.cartesian_prod(*[torch.arange(2, device=cell.device)] * 3)
        weight = torch.where(corners == 1, within[:, None], 1 - within[:, None]).prod(-1)
        row = self.row_of((cell[:, None] + corners).view(-1, 3)).view(-1, len(corners))
        weight = torch.where(row >= 0, weight, 0).to(self.rows.dtype)
        return torch.einsum("pc,pcw->pw", weight, self.rows[row.clamp(min=0)])

    def vertices(self, first: int = 0, last: int | None = None) -> Tensor:
        """The vertex of each row of the bricks first ≤ b < last: (64 · bricks, 3) int64."""
        brick = self.places()[first:last]
        inside = torch.cartesian_prod(*[torch.arange(BRICK, device=brick.device)] * 3)
        return (BRICK * brick[:, None] + inside).reshape(-1, 3)

    def at_vertex(self, other: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        """Where the vertices of the `other` grid lie in this one.

        Returns first and step, each (3,): in cells of this grid, vertex v of the other lies at first + v · step.
        """
        return (other.origin - self.origin) / self.voxel, other.voxel / self.voxel

    def state(self) -> dict[str, Tensor]:
        """The tensors of a checkpoint."""
        return {
            "origin": torch.from_numpy(self.origin), "voxel": torch.from_numpy(self.voxel),
            "occupied": self.occupied, "bricks": self.table >= 0, "rows": self.rows,
        }  # fmt: skip

    @staticmethod
    def restored(state: Mapping[str, Tensor], contracted: bool) -> VoxelGrid:
        """The grid that `state()` described.

        Raises ValueError if the tensors do not fit each other: the kernels check neither table nor cells.
        """
        occupied, bricks, rows = state["occupied"], state["bricks"], state["rows"]
        origin, voxel = (state[name].cpu().numpy().astype(np.float64) for name in ("origin", "voxel"))
        sound = (
            occupied.dtype == bricks.dtype == torch.bool and occupied.ndim == bricks.ndim == 3
            and rows.dtype == torch.float32 and origin.shape == voxel.shape == (3,)
            and bool(occupied.any()) and np.isfinite(origin).all() and (voxel > 0).all()
        )  # fmt: skip
        if not sound:
            raise ValueError("the voxel grid is not of the kind that is written")
        needed = bricks_of(occupied)
        if needed.shape != bricks.shape or bool((needed & ~bricks).any()):
            raise ValueError("the voxel grid lacks rows for its cells")
        count = int(bricks.sum())
        if rows.shape != (count * ROWS, WIDTH):
            raise ValueError("the voxel grid's rows do not fit its bricks")
        table = torch.full(bricks.shape, -1, dtype=torch.int32, device=rows.device)
        table[bricks] = torch.arange(count, dtype=torch.int32, device=rows.device)
        x, y, z = occupied.shape
        own = torch.empty_like(rows).copy_(rows)  # a copy: kernels change it in place, and need its alignment
        return VoxelGrid((x, y, z), origin, voxel, contracted, occupied.clone(), leaps(occupied), table, own)


def bricks_of(occupied: Tensor) -> Tensor:
    """The bricks that hold the vertices of cells: (x, y, z) bool → (bx, by, bz) bool."""
    x, y, z = occupied.shape
    vertices = torch.zeros([BRICK * (n // BRICK + 1) for n in (x, y, z)], dtype=torch.bool, device=occupied.device)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                vertices[a : a + x, b : b + y, c : c + z] |= occupied
    return blocks(vertices)


def view_basis(d: Tensor) -> Tensor:
    """Return the spherical harmonics of degree 0 and 1, in the order of a row's coefficients.

    d: unit directions (K, 3). Returns (K, 4).
    """
    return torch.stack([torch.full_like(d[:, 0], SH0), SH1 * d[:, 1], SH1 * d[:, 2], SH1 * d[:, 0]], -1)
