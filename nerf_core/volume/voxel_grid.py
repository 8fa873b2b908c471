"""A sparse grid of parameters: one row for each vertex of an occupied cell, none in empty space.

Cells have several sizes, as in an octree: the finest ones, and others whose sides are 2, 4, 8 … times as long. A cell
of `doublings` d begins at a multiple of 2ᵈ finest cells. Vertices of cells of one size are found by bricks of
4 × 4 × 4; neighbouring cells of different sizes have vertices of their own. A row has 16 float32, one cache line: 3 × 4
spherical-harmonic coefficients of colour, the raw density, and the vector g of gloss; see `colors_of`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.volume.cells import Cells, blocks, leaps

DOUBLINGS = 2  # of a cell's side, to a brick's
BRICK = 1 << DOUBLINGS  # cells a side, and vertices that are its own
WIDTH = 16  # floats of a row
MOST_SIZES = 10  # sizes of cells in a grid
MOST_CELLS = 1 << 12  # finest cells along a side: the march stores a cell's size above 12 bits of its place
DENSITY = 12  # where a row's raw density lies
GLOSS = slice(13, 16)  # where its vector of gloss lies
PARTS = (slice(DENSITY), slice(DENSITY, DENSITY + 1), GLOSS)  # of a row, each with one second moment
# 1/√4π and √(3/4π), as in `encodings.spherical_harmonics`, but rounded: as a float32, SH0 differs from the exact value
# by one unit in the last place, and another value would change the weights that a seed gives.
SH0, SH1 = 0.28209479, 0.48860251


class GridArrays(NamedTuple):
    """Numpy views of a `VoxelGrid`, for the kernels.

    The first six are the fields of `CellArrays`. table: all tables, one after another. begins: (D,) where each table
    begins. sides: (D, 2) its number of bricks along y and z. bricks: those of the grid, one after another.
    """

    origin: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    leap: np.ndarray
    kinds: np.ndarray
    contracted: bool
    table: np.ndarray
    begins: np.ndarray
    sides: np.ndarray
    bricks: np.ndarray


@dataclass(frozen=True)
class VoxelGrid(Cells):
    """Cells with parameters at their vertices. `size`, `voxel` and `kinds` count the finest cells.

    Vertices are found by bricks of 4³. Only those of occupied cells have a row, and a third of a brick's have none.

    kinds: (x, y, z) uint8 for each finest cell: 0 if it is empty, else 1 + the doublings of the cell that it is in.
    tables: for each number of doublings, (bx, by, bz) int32: the number of each brick; 0 where none is stored.
    table: all of them, one after another in the same memory: (T,) int32.
    bricks: (B + 1, 5, 5, 5) int32: the rows of the vertices of each brick's 4³ cells; −1 where none is stored, as in
        all of brick 0, which stands for none. The first 4³ are the brick's own, the others belong to its neighbours.
    rows: (M, 16) float32, brick after brick.
    """

    tables: tuple[Tensor, ...]
    table: Tensor
    bricks: Tensor
    rows: Tensor

    @staticmethod
    def over(origin: np.ndarray, voxel: np.ndarray, occupied: Tensor, contracted: bool) -> VoxelGrid:
        """A grid of zeros with cells of one size; for the arguments see `Cells`."""
        return VoxelGrid.of_kinds(origin, voxel, occupied.to(torch.uint8), contracted)

    @staticmethod
    def of_kinds(
        origin: np.ndarray, voxel: np.ndarray, kinds: Tensor, contracted: bool, sizes: int = 0,
        rows: Tensor | None = None,
    ) -> VoxelGrid:  # fmt: skip
        """A grid with rows for all vertices of occupied cells.

        sizes: how many tables it has; 0: one for each size up to the largest cell's. rows: None: zeros. For the other
        arguments see the class.
        """
        tables, own, first = [], [torch.full((1, BRICK, BRICK, BRICK), -1, dtype=torch.int32, device=kinds.device)], 0
        for cells in cells_of_each_size(kinds, sizes):
            vertices = vertices_of(cells)
            stored = blocks(vertices)
            held = blocks_of(vertices, DOUBLINGS)[stored]
            begin, last = sum(map(len, own)), first + int(held.count_nonzero())
            table = torch.zeros(stored.shape, dtype=torch.int32, device=kinds.device)
            table[stored] = torch.arange(begin, begin + len(held), dtype=torch.int32, device=kinds.device)
            numbers = torch.full(held.shape, -1, dtype=torch.int32, device=kinds.device)
            numbers[held] = torch.arange(first, last, dtype=torch.int32, device=kinds.device)
            tables.append(table)
            own.append(numbers)
            first = last
        x, y, z = kinds.shape
        bricks = _with_neighbours(torch.cat(own), tables)
        table = torch.cat([one.flatten() for one in tables])
        parts = table.split([one.numel() for one in tables])
        views = tuple(part.view(one.shape) for part, one in zip(parts, tables, strict=True))
        return VoxelGrid(
            (x, y, z), origin, voxel, contracted, kinds, leaps(kinds > 0), views, table, bricks,
            torch.zeros(first, WIDTH, device=kinds.device) if rows is None else rows,
        )  # fmt: skip

    def arrays(self) -> GridArrays:
        """The arrays that the CPU kernels read."""
        shapes = np.array([table.shape for table in self.tables], np.int64)
        begins, sides = np.cumsum(shapes.prod(1)) - shapes.prod(1), np.ascontiguousarray(shapes[:, 1:])
        return GridArrays(*self.cell_arrays(), self.table.numpy(), begins, sides, self.bricks.numpy().ravel())

    @property
    def brick_count(self) -> int:
        """Number of bricks that are stored."""
        return len(self.bricks) - 1

    def rows_of(self, first: int, last: int) -> slice:
        """The rows of the bricks first ≤ b < last, counted from 0."""
        own = self._own_rows[first:last]
        own = own[own >= 0]
        return slice(int(own[0]), int(own[-1]) + 1)

    def with_cells(self, occupied: Tensor) -> tuple[VoxelGrid, Tensor]:
        """Drop the other cells. A larger cell stays or goes whole.

        Args:
            occupied: (x, y, z) bool, the cells that stay.

        Returns:
            The grid without rows, and which rows of this one it is to have: (M,) bool.
        """
        kinds, kept = self.kinds * occupied, []
        for cells, table in zip(cells_of_each_size(kinds, len(self.tables)), self.tables, strict=True):
            of_bricks = self._own_rows[table[table > 0].long() - 1]
            kept.append(blocks_of(vertices_of(cells), DOUBLINGS)[table > 0][of_bricks >= 0])
        sizes = len(self.tables)
        grid = VoxelGrid.of_kinds(self.origin, self.voxel, kinds, self.contracted, sizes, self.rows[:0])
        return grid, torch.cat(kept)

    def cells_with(self, values: Tensor) -> tuple[Tensor, ...]:
        """Spread one value for each row (M,) over the cells whose lowest vertex the row is.

        Returns a tensor for each number of doublings d, (⌈x/2ᵈ⌉, ⌈y/2ᵈ⌉, ⌈z/2ᵈ⌉), with zero where no row is stored.
        """
        spread, first = [], 0
        for d, table in enumerate(self.tables):
            bricks = torch.zeros(*table.shape, BRICK, BRICK, BRICK, dtype=values.dtype, device=values.device)
            stored = table > 0
            held = self._own_rows[table[stored].long() - 1] >= 0
            spaced, count = torch.zeros_like(held, dtype=values.dtype), int(held.count_nonzero())
            spaced[held] = values[first : first + count]
            bricks[stored], first = spaced, first + count
            shape = [BRICK * n for n in table.shape]
            whole = bricks.permute(0, 3, 1, 4, 2, 5).reshape(shape)
            x, y, z = (-(-n >> d) for n in self.size)
            spread.append(whole[:x, :y, :z])
        return tuple(spread)

    @cached_property
    def places(self) -> Tensor:
        """For each brick in the order of the rows, its doublings and its place in that table: (B, 4) int64."""
        found = []
        for d, table in enumerate(self.tables):
            place = (table > 0).nonzero()
            found.append(torch.cat([torch.full_like(place[:, :1], d), place], -1))
        return torch.cat(found).contiguous()

    def row_of(self, vertex: Tensor, doublings: Tensor | int = 0) -> Tensor:
        """The rows of vertices.

        vertex: (P, 3) int64, counted in cells of their size. doublings: (P,) int64 or one number, that size.
        Returns (P,) int64, −1 outside of the grid and where no row is stored.
        """
        size = torch.as_tensor(doublings, device=vertex.device).expand(len(vertex))
        row = torch.full_like(vertex[:, 0], -1)
        for d, table in enumerate(self.tables):
            most = BRICK * torch.tensor(table.shape, device=vertex.device)
            inside = ((vertex >= 0) & (vertex < most)).all(-1) & (size == d)
            v = torch.where(inside[:, None], vertex, 0)
            b = v // BRICK
            place = (v - BRICK * b).unbind(-1)
            row = torch.where(inside, self.bricks[table[b[:, 0], b[:, 1], b[:, 2]].long(), *place].long(), row)
        return row

    def doublings_of(self, cell: Tensor) -> Tensor:
        return (self.kinds[tuple(cell.unbind(-1))].long() - 1).clamp(min=0)

    def own(self, cell: Tensor, within: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Find the cells, of any size, that finest cells are part of. An empty one is a cell of its own.

        cell: (P, 3) int64. within: (P, 3) in [0, 1], the position in it.
        Returns the doublings (P,) int64, the cells (P, 3) counted in cells of their size, and the positions in them.
        """
        doublings = self.doublings_of(cell)
        own = cell >> doublings[:, None]
        inside = cell - (own << doublings[:, None])
        return doublings, own, (inside + within) / (1 << doublings[:, None])

    def interpolate(self, cell: Tensor, within: Tensor) -> Tensor:
        """Interpolate rows trilinearly. Vertices without a row count as zero.

        cell: (P, 3) int64, finest cells. within: (P, 3) in [0, 1], the position in the cell. Returns (P, 16).
        """
        doublings, own, within = self.own(cell, within)
        corners = torch.cartesian_prod(*[torch.arange(2, device=cell.device)] * 3)
        weight = torch.where(corners == 1, within[:, None], 1 - within[:, None]).prod(-1)
        row = self.row_of((own[:, None] + corners).view(-1, 3), doublings.repeat_interleave(len(corners)))
        row = row.view(-1, len(corners))
        weight = torch.where(row >= 0, weight, 0).to(self.rows.dtype)
        return torch.einsum("pc,pcw->pw", weight, self.rows[row.clamp(min=0)])

    def vertices(self, first: int = 0, last: int | None = None) -> Tensor:
        """The vertex of each row of the bricks first ≤ b < last, in finest cells: (rows, 3) int64."""
        place = self.places[first:last]
        inside = torch.cartesian_prod(*[torch.arange(BRICK, device=place.device)] * 3)
        return ((BRICK * place[:, None, 1:] + inside) << place[:, None, :1])[self._own_rows[first:last].flatten(1) >= 0]

    def doublings_of_rows(self, first: int = 0, last: int | None = None) -> Tensor:
        """The doublings of the size that each row of the bricks first ≤ b < last belongs to: (rows,) int64."""
        return self.places[first:last, :1].expand(-1, BRICK**3)[self._own_rows[first:last].flatten(1) >= 0]

    @property
    def _own_rows(self) -> Tensor:
        """The rows of each brick's own vertices, without brick 0: (B, 4, 4, 4)."""
        return self.bricks[1:, :BRICK, :BRICK, :BRICK]

    def at_vertex(self, other: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        """Where the vertices of the `other` grid lie in this one.

        Returns first and step, each (3,): in finest cells of this grid, finest vertex v of the other lies at
        first + v · step.
        """
        return (other.origin - self.origin) / self.voxel, other.voxel / self.voxel

    def state(self) -> dict[str, Tensor]:
        """The tensors of a checkpoint."""
        box = {"origin": torch.from_numpy(self.origin), "voxel": torch.from_numpy(self.voxel)}
        return box | {"sizes": torch.tensor(len(self.tables)), "kinds": self.kinds, "rows": self.rows}

    @staticmethod
    def restored(state: Mapping[str, Tensor], contracted: bool) -> VoxelGrid:
        """The grid that `state()` described.

        Raises ValueError if the tensors do not fit each other: the kernels do not check cells.
        """
        kinds, rows, sizes = state["kinds"], state["rows"], int(state["sizes"])
        origin, voxel = (state[name].cpu().numpy().astype(np.float64) for name in ("origin", "voxel"))
        sound = (
            kinds.dtype == torch.uint8 and kinds.ndim == 3 and 1 <= sizes <= MOST_SIZES
            and rows.dtype == torch.float32 and origin.shape == voxel.shape == (3,)
            and max(kinds.shape) <= MOST_CELLS and bool(kinds.any()) and np.isfinite(origin).all() and (voxel > 0).all()
        )  # fmt: skip
        if not sound or int(kinds.max()) > sizes or any(n % (1 << (sizes - 1)) for n in kinds.shape):
            raise ValueError("the voxel grid is not of the kind that is written")
        kinds = kinds.contiguous().clone()
        if any(not torch.equal(spread(c, d), kinds == d + 1) for d, c in enumerate(cells_of_each_size(kinds, sizes))):
            raise ValueError("the voxel grid has parts of cells")
        if rows.shape != (row_count(kinds), WIDTH):  # before cells that have none take memory
            raise ValueError("the voxel grid's rows do not fit its cells")
        own = rows.clone(memory_format=torch.contiguous_format)  # kernels change it in place, and need its alignment
        return VoxelGrid.of_kinds(origin, voxel, kinds, contracted, sizes, own)


def cells_of_each_size(kinds: Tensor, sizes: int = 0) -> list[Tensor]:
    """The cells of each size: for each number of doublings d, (⌈x/2ᵈ⌉, ⌈y/2ᵈ⌉, ⌈z/2ᵈ⌉) bool.

    kinds: as in `VoxelGrid`. sizes: how many sizes there are; 0: as many as `kinds` has.
    """
    return [kinds[:: 1 << d, :: 1 << d, :: 1 << d] == d + 1 for d in range(sizes or max(1, int(kinds.max())))]


def spread(cells: Tensor, doublings: int) -> Tensor:
    """Repeat each cell 2ᵈ times along each axis: (x, y, z) → (2ᵈ x, 2ᵈ y, 2ᵈ z)."""
    if doublings == 0:
        return cells  # three copies less
    for axis in range(3):
        cells = cells.repeat_interleave(1 << doublings, axis)
    return cells


def pooled(cells: Tensor, doublings: int) -> Tensor:
    """The greatest of 2ᵈ × 2ᵈ × 2ᵈ cells; the sides are multiples of 2ᵈ: the reverse of `spread`."""
    return blocks_of(cells, doublings).amax((3, 4, 5))


def blocks_of(cells: Tensor, doublings: int) -> Tensor:
    """View 2ᵈ × 2ᵈ × 2ᵈ cells as a block: (2ᵈ x, 2ᵈ y, 2ᵈ z) → (x, y, z, 2ᵈ, 2ᵈ, 2ᵈ)."""
    side = 1 << doublings
    x, y, z = (n // side for n in cells.shape)
    return cells.view(x, side, y, side, z, side).permute(0, 2, 4, 1, 3, 5)


def vertices_of(cells: Tensor) -> Tensor:
    """The vertices of cells, with room for whole bricks: (x, y, z) bool → (4 bx, 4 by, 4 bz) bool."""
    x, y, z = cells.shape
    vertices = torch.zeros([BRICK * (n // BRICK + 1) for n in (x, y, z)], dtype=torch.bool, device=cells.device)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                vertices[a : a + x, b : b + y, c : c + z] |= cells
    return vertices


def row_count(kinds: Tensor) -> int:
    """How many rows a grid of these cells has; `kinds` as in `VoxelGrid`."""
    # not sums, which take eight bytes for each vertex
    return sum(int(vertices_of(cells).count_nonzero()) for cells in cells_of_each_size(kinds))


def _with_neighbours(own: Tensor, tables: list[Tensor]) -> Tensor:
    """Add the neighbours' first vertices to the rows of the bricks' own: (B + 1, 4, 4, 4) → (B + 1, 5, 5, 5)."""
    whole = functional.pad(own, (0, 1) * 3, value=-1)
    own_part, far, near = slice(BRICK), slice(BRICK, None), slice(1)
    for table in tables:
        number, place = table[table > 0].long(), (table > 0).nonzero()
        padded = functional.pad(table, (0, 1) * 3)
        for beside in itertools.islice(itertools.product((0, 1), repeat=3), 1, None):
            x, y, z = (place + torch.tensor(beside, device=place.device)).unbind(-1)
            theirs = own[padded[x, y, z].long()]
            there, here = ([far if n else own_part for n in beside], [near if n else own_part for n in beside])
            whole[(number, *there)] = theirs[(slice(None), *here)]
    return whole


def view_basis(d: Tensor) -> Tensor:
    """Return the spherical harmonics of degree 0 and 1, in the order of a row's coefficients.

    d: unit directions (…, 3). Returns (…, 4).
    """
    return torch.stack([torch.full_like(d[..., 0], SH0), SH1 * d[..., 1], SH1 * d[..., 2], SH1 * d[..., 0]], -1)


def colors_of(rows: Tensor, d: Tensor) -> Tensor:
    """Return the colours (…, 3) that interpolated rows emit: c(d) = sigmoid(Σ_b k_b Y_b(d) + (g · d)²).

    The four harmonics change slowly with the direction of view. (g · d)² is narrower, and never negative: two lobes
    along g, of which a surface shows one. A highlight brightens all channels alike, and so does this.

    Args:
        rows: (…, 16).
        d: unit directions of view (…, 3).
    """
    k, y, g = rows[..., :DENSITY].unflatten(-1, (3, 4)), view_basis(d), rows[..., GLOSS]
    # sums one by one, because rows and directions may be broadcast to all pairs
    lobe = g[..., 0] * d[..., 0] + g[..., 1] * d[..., 1] + g[..., 2] * d[..., 2]
    harmonics = k[..., 0] * y[..., :1] + k[..., 1] * y[..., 1:2] + k[..., 2] * y[..., 2:3] + k[..., 3] * y[..., 3:]
    return torch.sigmoid(harmonics + lobe.square()[..., None])
