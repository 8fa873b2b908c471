"""Coarse to fine: which levels a voxel grid goes through, and how the grid of one becomes that of the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space, pixel_size
from nerf_core.kernels.voxel_kernels import HALVINGS, VoxelKernels
from nerf_core.methods.voxels.config import VoxelConfig
from nerf_core.volume.cells import grow
from nerf_core.volume.voxel_grid import (
    BRICK,
    DENSITY,
    WIDTH,
    VoxelGrid,
    blocks_of,
    pooled,
    row_count,
    spread,
)

BRICKS = 1024  # bricks of a new grid between two calls of the yield callback: about 10 ms on two cores
LARGER = 1.05  # cells of a first grid with too many rows become larger by at least this factor at a time


def nothing() -> None:
    """The default yield callback."""


class Level(NamedTuple):
    """A level of the grid.

    scale: how many times larger its cells are than the finest.
    begin: its first step.
    shrink: photos are averaged over shrink × shrink pixels.
    """

    scale: float
    begin: int
    shrink: int


@dataclass(frozen=True)
class Schedule:
    """When the grid becomes finer, and when empty cells are dropped.

    levels: from the coarsest to the finest.
    finest: (3,) the sides of the finest cells in box coordinates.
    prune_every: steps between prunings in the last level.
    """

    levels: list[Level]
    finest: np.ndarray
    prune_every: int

    @staticmethod
    def of(scene: Scene, space: Space, config: VoxelConfig) -> Schedule:
        finest = finest_cells(scene, space, config)
        return Schedule(planned(space, config, finest), finest, config.prune_every)

    def level_at(self, step: int) -> int:
        return max(i for i, level in enumerate(self.levels) if level.begin <= step)

    def voxel(self, level: int) -> np.ndarray:
        """Return the sides (3,) of a level's cells in box coordinates."""
        return self.finest * self.levels[level].scale

    def drops(self, step: int) -> bool:
        """Whether to drop cells in a step of the last level: after `prune_every` steps, 3, 7, 15 … times as many.

        The levels before drop cells at their end.
        """
        times, rest = divmod(step - self.levels[-1].begin, self.prune_every)
        return times > 0 and rest == 0 and (times + 1).bit_count() == 1


def finest_cells(scene: Scene, space: Space, c: VoxelConfig) -> np.ndarray:
    """Return the sides (3,) of the finest cells in box coordinates: `pixels` photo pixels at the scene's centre."""
    cameras = [scene.views[i].camera for i in scene.split("train")]
    if space.kind == "ndc":
        width, height = (max(getattr(v, side) for v in cameras) for side in ("width", "height"))
        voxel = np.array([2 * c.pixels / width, 2 * c.pixels / height, 2 / c.planes])
    else:
        voxel = np.full(3, c.pixels * pixel_size(scene, space))
    return np.maximum(voxel, (space.high - space.low).max() / c.resolution)


def planned(space: Space, c: VoxelConfig, finest: np.ndarray) -> list[Level]:
    """Return the levels, each with cells half as large as the one before, down to the finest ones.

    The first has about `start` cells along the box's longest side. Each level has twice as many steps as the one
    before, and the last has all the rest. The last waits for `wait` steps for each thousand cells of a side of the
    box: many small cells learn slowly, and begin better from larger ones that have learnt.
    """
    side = (space.high - space.low).max() / finest.min()
    halvings = max(0, round(math.log2(side / c.start)))
    levels, begin = [], 0
    for i in range(halvings + 1):
        scale = 2.0 ** (halvings - i)
        shrink = 2 ** max(0, int(math.log2(max(scale * c.pixels, 1))))
        if i == halvings > 0:
            begin = max(begin, math.ceil(c.wait * side**2 / 1000))
        levels.append(Level(scale, begin, shrink))
        begin += c.level_steps << i
    return levels


def first_grid(space: Space, voxel: np.ndarray, most_rows: int) -> VoxelGrid:
    """Return a grid over the whole box whose cells are all occupied.

    Args:
        space: the space with its box.
        voxel: (3,) the cells' sides in box coordinates. They become larger if the grid has too many rows.
        most_rows: the most rows that the grid may have.
    """
    while True:
        size = np.ceil((space.high - space.low) / voxel - 1e-6).astype(int)
        if math.prod(size + 1) <= most_rows:
            break
        voxel = LARGER * voxel
    everything = torch.ones(*size.tolist(), dtype=torch.bool)
    return VoxelGrid.over(space.low, voxel, everything, space.kind == "contracted")


@dataclass(frozen=True)
class Worth:
    """What a grid's cells are worth; see `VoxelKernels.marked`.

    needed: (x, y, z) bool like `occupied`, the cells that some pixel needs, and their neighbours.
    of_each: for each number of doublings, what each cell of that size is worth to the photo that needs it second most.
        Only two photos tell where a surface is: what one sees alone may be haze before its camera.
    """

    needed: Tensor
    of_each: tuple[Tensor, ...]

    @staticmethod
    def of(
        grid: VoxelGrid, best: Tensor, second: Tensor, beside: float, yield_callback: Callable[[], None] = nothing
    ) -> Worth:
        """Spread over the cells what their rows are worth, (M,) uint8.

        best, second: to the photo that needs the cell most, and second most.
        beside: cells beside one with at least this weight in some pixel are needed too.
        """
        of_each = grid.cells_with(best)
        needed = _around(grid, of_each, yield_callback) >= class_of(beside)
        for d, worth in enumerate(of_each):
            yield_callback()
            needed |= spread(worth > 0, d)[tuple(slice(n) for n in grid.size)]
        del of_each  # a byte for each of the finest cells
        return Worth(needed.logical_and_(grid.occupied), grid.cells_with(second))


def class_of(weight: float) -> int:
    """What a cell is worth that has this weight in some pixel: 1 + HALVINGS − h, 2⁻ʰ ≥ weight > 2⁻ʰ⁻¹."""
    return max(1, 1 + HALVINGS - math.floor(-math.log2(weight)))


def _around(grid: VoxelGrid, of_each: tuple[Tensor, ...], yield_callback: Callable[[], None]) -> Tensor:
    """The greatest worth among each cell and its neighbours: (x, y, z) uint8, 0 where no cell is."""
    found = grow(of_each[0])
    for d, worth in enumerate(of_each[1:], 1):
        yield_callback()
        torch.maximum(found, spread(grow(worth), d)[tuple(slice(n) for n in grid.size)], out=found)
    for d in range(1, len(of_each)):  # a larger cell is taken whole
        yield_callback()
        own = grid.kinds[:: 1 << d, :: 1 << d, :: 1 << d] == d + 1
        blocks_of(found, d)[own] = pooled(found, d)[own][:, None, None, None]
    return found.mul_(grid.occupied)


def finer_grid(
    old: VoxelGrid, worth: Worth, split: float, most_rows: int, yield_callback: Callable[[], None] = nothing
) -> tuple[VoxelGrid, bool]:
    """Return a grid with cells of half the size where that shows, without values; and whether it lacks rows for more.

    The cells that no pixel needs are dropped. Those that have a weight of at least `split` in pixels of two photos, and
    their neighbours, are divided into eight. The others stay as they are: thin haze gains nothing from smaller cells.

    Args:
        old: the grid of the level before.
        worth: what its cells are worth. Some must be needed.
        split: the weight; it becomes larger if the grid has too many rows.
        most_rows: the most rows that the grid may have.
    """
    aligned = BRICK << (len(old.tables) - 1)  # bricks begin where they did, so that there are no more of them
    found = worth.needed.nonzero()
    low, high = found.amin(0) // aligned * aligned, -(-(found.amax(0) + 1) // aligned) * aligned
    box = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    kept, around = (old.kinds * worth.needed)[box], _around(old, worth.of_each, yield_callback)[box]
    least, count = class_of(split) - 1, most_rows + 1
    kinds = kept
    while count > most_rows and least <= class_of(1.0):  # nothing is worth more than that: no cell is divided
        least += 1
        yield_callback()
        kinds = spread(kept + ((kept > 0) & (around < least)), 1)
        count = row_count(kinds)
    grid = VoxelGrid.of_kinds(old.origin + low.numpy() * old.voxel, old.voxel / 2, kinds, old.contracted)
    return grid, least > class_of(split)


def resample(
    kernels: VoxelKernels, old: VoxelGrid, new: VoxelGrid, bias: float, yield_callback: Callable[[], None]
) -> None:
    """Fill `new` with the values of `old`, so that both show the same picture.

    Density is per side of a cell, so that a smaller cell has less of it: σ' = σ · (side of new / side of old).
    """
    finer = float(np.prod(new.voxel / old.voxel) ** (1 / 3))
    for first in range(0, new.brick_count, BRICKS):
        yield_callback()
        last = min(first + BRICKS, new.brick_count)
        doublings = kernels.resample(old, new, first, last)
        raw = new.rows[new.rows_of(first, last), DENSITY]
        ratio = finer * 2.0 ** (new.doublings_of_rows(first, last) - doublings.long())
        sigma = (functional.softplus(raw + bias) * ratio).clamp(min=1e-30)  # 1e-30 keeps the logarithm finite
        raw.copy_(torch.where(ratio == 1, raw, sigma + torch.log(-torch.expm1(-sigma)) - bias))  # softplus' inverse


def resampled_moments(
    kernels: VoxelKernels, old: VoxelGrid, moments: Tensor, new: VoxelGrid, yield_callback: Callable[[], None] = nothing
) -> Tensor:
    """Return the second moments for a finer grid, so that training goes on as if nothing had happened.

    A smaller cell has an eighth of the samples' weight in its gradient, and 1/64 in the squares.

    Args:
        kernels: they interpolate.
        old: the coarser grid.
        moments: (M, 3) those of its rows.
        new: the finer grid.
        yield_callback: called between pieces of the work.
    """
    width = moments.shape[1]
    wide = replace(old, rows=functional.pad(moments, (0, WIDTH - width)))  # the kernels interpolate whole rows
    room, found = replace(new, rows=torch.zeros_like(new.rows)), torch.empty(len(new.rows), width)
    for first in range(0, new.brick_count, BRICKS):
        yield_callback()
        last = min(first + BRICKS, new.brick_count)
        doublings = kernels.resample(wide, room, first, last)
        divided = new.doublings_of_rows(first, last) == doublings.long()
        part = new.rows_of(first, last)
        found[part] = room.rows[part, :width] / torch.where(divided, 64, 1)[:, None]
    return found
