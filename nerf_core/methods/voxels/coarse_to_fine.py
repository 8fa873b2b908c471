"""Coarse to fine: which levels a voxel grid goes through, and how the grid of one becomes that of the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space, pixel_size
from nerf_core.kernels.voxel_kernels import VoxelKernels
from nerf_core.methods.voxels.config import VoxelConfig
from nerf_core.volume.voxel_grid import BRICK, DENSITY, ROWS, VoxelGrid, bricks_of

BRICKS = 2048  # bricks of a new grid between two calls of the yield callback: about 10 ms on two cores
SHORTEST_LEVEL = 1.25  # the last level must be finer than the one before by at least this factor
LARGER = 1.05  # cells of a grid with too many rows become larger by at least this factor at a time


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

    def forgets(self, level: int, since: int) -> bool:
        """Whether to forget which cells were seen after `since` steps of a level: half way to the next pruning.

        The first half does not count, because it is mostly fog.
        """
        last = level == len(self.levels) - 1
        end = self.prune_every if last else self.levels[level + 1].begin - self.levels[level].begin
        return since == end // 2

    def prunes(self, level: int, since: int) -> bool:
        """Whether to drop empty cells after `since` steps of a level. Levels before the last do so at their end."""
        return level == len(self.levels) - 1 and since % self.prune_every == 0


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
    """Return the levels: from `start` cells to the finest ones in steps of `growth`, and the last step as needed."""
    coarsest = (space.high - space.low).max() / c.start / finest.min()
    count = max(0, math.ceil(math.log(max(coarsest, 1) / SHORTEST_LEVEL) / math.log(c.growth)))
    levels, begin, steps = [], 0, float(c.level_steps)
    for i in range(count + 1):
        scale = max(coarsest, 1.0) ** (1 - i / count) if count else 1.0
        shrink = 2 ** max(0, int(math.log2(max(scale * c.pixels, 1))))
        levels.append(Level(scale, begin, shrink))
        begin += round(steps)
        steps *= c.growth
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
        if ROWS * math.prod(size // BRICK + 1) <= most_rows:
            break
        voxel = LARGER * voxel
    everything = torch.ones(*size.tolist(), dtype=torch.bool)
    return VoxelGrid.over(space.low, voxel, everything, space.kind == "contracted")


def finer_grid(old: VoxelGrid, cells: Tensor, voxel: np.ndarray, most_rows: int) -> VoxelGrid:
    """Return a grid over the smallest box around some cells, without values.

    Args:
        old: the grid of the level before.
        cells: bool, its cells that the new grid divides. At least one must be True.
        voxel: (3,) the new cells' sides in box coordinates. They become larger if the grid has too many rows.
        most_rows: the most rows that the grid may have.
    """
    found = cells.nonzero()
    low, high = found.amin(0).numpy(), found.amax(0).numpy() + 1
    origin, far = old.origin + low * old.voxel, old.origin + high * old.voxel
    while True:
        size = np.ceil((far - origin) / voxel - 1e-6).astype(int)
        centres = [torch.from_numpy(((np.arange(n) + 0.5) * voxel[a] + origin[a] - old.origin[a]) / old.voxel[a])
                   for a, n in enumerate(size)]  # fmt: skip
        x, y, z = (v.floor().long().clamp(0, n - 1) for v, n in zip(centres, old.size, strict=True))
        occupied = cells[x][:, y][:, :, z]
        rows = ROWS * int(bricks_of(occupied).sum())
        if rows <= most_rows:
            break
        voxel = voxel * max(LARGER, (rows / most_rows) ** (1 / 3))
    return VoxelGrid.over(origin, voxel, occupied, old.contracted)


def resample(
    kernels: VoxelKernels, old: VoxelGrid, new: VoxelGrid, bias: float, yield_callback: Callable[[], None]
) -> None:
    """Fill `new` with the values of `old`, so that both show the same picture.

    Density is per cell, so that a smaller cell has less of it: σ' = σ · (side of new / side of old).
    """
    ratio = float(np.prod(new.voxel / old.voxel) ** (1 / 3))
    for first in range(0, new.bricks, BRICKS):
        yield_callback()
        last = min(first + BRICKS, new.bricks)
        kernels.resample(old, new, first, last)
        raw = new.rows[ROWS * first : ROWS * last, DENSITY]
        sigma = (functional.softplus(raw + bias) * ratio).clamp(min=1e-30)  # 1e-30 keeps the logarithm finite
        raw.copy_(sigma + torch.log(-torch.expm1(-sigma)) - bias)  # the inverse of softplus
