"""The voxel grid on a CPU: numba's loops, run over shards in threads. Each shard has its own gradients.

Rays are divided into shards by position, and gradients are summed in the order of the shards. So the same seed and
thread count give the same weights, bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.jit.shards import each_shard, shards_of, split
from nerf_core.geometry.fast_rays import fast_rays, photo_colors
from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels import numba_cells as cells
from nerf_core.kernels import numba_march as note
from nerf_core.kernels import numba_voxels as loops
from nerf_core.kernels.cpu_rays import ray_arrays
from nerf_core.kernels.numba_depths import depth_gradients
from nerf_core.kernels.voxel_kernels import Adam, March, Traced
from nerf_core.volume.voxel_grid import PARTS, WIDTH, VoxelGrid

FIRST_CAPACITY = 24  # samples a ray that a trace allocates first


class _Scratch(NamedTuple):
    corners: np.ndarray
    weights: np.ndarray
    values: np.ndarray
    notes: np.ndarray
    lobes: np.ndarray


class CpuVoxels:
    """`VoxelKernels` through numba."""

    name = "numba"

    def __init__(self, shards: int) -> None:
        self.shards = shards
        self._scratch: list[_Scratch] = []
        self.forget()

    def render(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Tensor:
        arrays, given, scratch = grid.arrays(), ray_arrays(rays, how.offsets), self._buffers(grid, how)
        pixel = torch.empty(len(rays), 5)
        out, rows, background = pixel.numpy(), grid.rows.numpy().ravel(), how.background.numpy()

        shards = shards_of(len(rays), self.shards)

        def work(s: int) -> None:
            first, last = split(len(rays), shards, s)
            loops.render(
                arrays, given, first, last, np.float32(how.step), np.float32(how.bias), rows, background,
                scratch[s], out,
            )  # fmt: skip

        each_shard(shards, work)
        return pixel

    def trace(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Traced:
        arrays, given, scratch = grid.arrays(), ray_arrays(rays, how.offsets), self._buffers(grid, how)
        pixel, counts = torch.empty(len(rays), 5), torch.zeros(len(rays), dtype=torch.long)
        rows, background = grid.rows.numpy().ravel(), how.background.numpy()
        shards = shards_of(len(rays), self.shards)
        longest, parts = len(scratch[0].notes) // note.NOTES, [torch.empty(0)] * shards

        def work(s: int) -> None:
            first, last = split(len(rays), shards, s)
            capacity = FIRST_CAPACITY * (last - first) + longest
            while True:
                kept = torch.empty(capacity, note.NOTES)
                found = loops.trace(
                    arrays, given, first, last, np.float32(how.step), np.float32(how.bias), rows, background,
                    scratch[s], pixel.numpy(), kept.numpy(), counts.numpy(),
                )  # fmt: skip
                if found <= capacity:
                    break
                capacity = found
            parts[s] = kept[:found]

        each_shard(shards, work)
        notes = torch.cat(parts)
        return Traced(
            row_offsets=torch.cat([counts.new_zeros(1), counts.cumsum(0)]), t=notes[:, note.DISTANCE],
            width=notes[:, note.WIDTH], raw=notes[:, note.RAW], alpha=notes[:, note.ALPHA],
            transmittance=notes[:, note.TRANSMITTANCE], rgb=notes[:, note.RED : note.RED + 3], pixel=pixel,
        )  # fmt: skip

    def resample(self, old: VoxelGrid, new: VoxelGrid, first: int, last: int) -> Tensor:
        begin, step = old.at_vertex(new)
        arrays, places, rows_of = old.arrays(), new.places[first:last].numpy(), new.rows_of(first, last)
        rows, out = old.rows.numpy().ravel(), new.rows[rows_of].numpy().ravel()
        found = torch.zeros(len(new.rows[rows_of]), dtype=torch.uint8)
        bricks = new.bricks[1:][first:last].numpy()

        def work(s: int) -> None:
            part = split(len(places), self.shards, s)
            cells.resample(
                arrays, rows, begin, step, places, bricks, rows_of.start, *part, _scratch(1), out, found.numpy()
            )

        each_shard(self.shards, work)
        return found

    def accumulate(self, grid: VoxelGrid, rays: BoxRays, truth: Tensor, how: March) -> tuple[float, int]:
        arrays, given, scratch = grid.arrays(), ray_arrays(rays, how.offsets), self._buffers(grid, how)
        self._fit(grid)
        rows, background, colors = grid.rows.numpy().ravel(), how.background.numpy(), truth.numpy()
        pixel = np.empty((len(rays), 5), np.float32)
        sums = [(0.0, 0)] * self.shards

        def work(s: int) -> None:
            first, last = split(len(rays), self.shards, s)
            sums[s] = loops.gradients(
                arrays, given, colors, first, last, np.float32(how.step), np.float32(how.bias), rows, background,
                scratch[s], pixel, self._gradient[s], self._touched[s], np.float32(how.smoothness),
                np.float32(how.smoothness_color), np.float32(how.slope), np.float32(how.turn),
                np.float32(how.distortion), np.float32(how.reach), np.float32(how.unit), how.folded,
            )  # fmt: skip

        each_shard(self.shards, work)
        return sum(error for error, _ in sums), sum(samples for _, samples in sums)

    def accumulate_depths(self, grid: VoxelGrid, rays: BoxRays, t: Tensor, how: March) -> None:
        arrays, given, scratch = grid.arrays(), ray_arrays(rays, how.offsets), self._buffers(grid, how)
        self._fit(grid)
        rows, background, places = grid.rows.numpy().ravel(), how.background.numpy(), t.numpy()
        pixel = np.empty((len(rays), 5), np.float32)

        def work(s: int) -> None:
            depth_gradients(
                arrays, given, places, *split(len(rays), self.shards, s), np.float32(how.step), np.float32(how.bias),
                rows, background, scratch[s], pixel, self._gradient[s], self._touched[s], np.float32(how.depth),
                np.float32(how.unit), how.folded,
            )  # fmt: skip

        each_shard(self.shards, work)

    def forget(self) -> None:
        self._grid: VoxelGrid | None = None  # the grid that the buffers below have the size of
        self._gradient = np.zeros((self.shards, 0), np.float32)
        self._touched = np.zeros((self.shards, 0), np.uint64)  # a bit a row
        self._marks = np.zeros((self.shards, 0), np.uint8)

    def gradient(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return torch.from_numpy(self._gradient.sum(0)).view(-1, WIDTH)

    def mark(self, grid: VoxelGrid, rays: BoxRays, how: March, spare: float) -> None:
        arrays, given, scratch = grid.arrays(), ray_arrays(rays, how.offsets), self._buffers(grid, how)
        self._fit(grid)
        rows, background, pixel = (
            grid.rows.numpy().ravel(),
            how.background.numpy(),
            np.empty((len(rays), 5), np.float32),
        )

        def work(s: int) -> None:
            cells.mark(
                arrays, given, *split(len(rays), self.shards, s), np.float32(how.step), np.float32(how.bias), rows,
                background, scratch[s], pixel, self._marks[s], np.float32(spare),
            )  # fmt: skip

        each_shard(self.shards, work)

    def marked(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return torch.from_numpy(self._marks.max(0))

    def unmark(self) -> None:
        self._marks[:] = 0

    def update(self, grid: VoxelGrid, moments: Tensor, ema: Tensor, adam: Adam) -> None:
        self._fit(grid)
        rows, slots, emas = (v.numpy().ravel() for v in (grid.rows, moments, ema))

        def work(s: int) -> None:
            first, last = split(self._touched.shape[1], self.shards, s)
            loops.adam(first, last, rows, slots, emas, self._gradient, self._touched, *(np.float32(v) for v in adam))

        each_shard(self.shards, work)

    def _fit(self, grid: VoxelGrid) -> None:
        """Have empty buffers of the grid's size, if they do not hold what was summed over this very grid."""
        if self._grid is not None and self._grid.rows is grid.rows:
            return
        if self._grid is not None and self._marks.shape[1] == len(grid.rows):  # other rows of one grid, as its EMA
            self._marks[:] = 0
            if self._touched.any():
                self._gradient[:] = 0
                self._touched[:] = 0
        else:
            self.forget()  # first, to free the memory, and in case that there is not enough below
            gradient = torch.zeros(self.shards, len(grid.rows) * WIDTH).numpy()
            self._touched = np.zeros((self.shards, -(-len(grid.rows) // 64)), np.uint64)
            self._marks = np.zeros((self.shards, len(grid.rows)), np.uint8)
            self._gradient = gradient
        self._grid = grid

    def _buffers(self, grid: VoxelGrid, how: March) -> list[_Scratch]:
        # A straight ray crosses at most as many cells as the box has along its three sides together. A ray that is
        # bent by contraction may cross a few more.
        capacity = int(1.5 * sum(grid.size) / how.step) + 8
        if not self._scratch or len(self._scratch[0].corners) < 8 * capacity:
            self._scratch = [_scratch(capacity) for _ in range(self.shards)]
        return self._scratch


def _scratch(samples: int) -> _Scratch:
    """Buffers for so many samples. They are made by torch, whose tensors begin at a cache line, as vectors must."""
    return _Scratch(
        torch.empty(8 * samples, dtype=torch.int64).numpy(), torch.empty(8 * samples).numpy(), torch.zeros(256).numpy(),
        torch.empty(note.NOTES * samples).numpy(), torch.empty(samples).numpy(),
    )  # fmt: skip


def call_each() -> None:
    """Call each of the loops once; for `compile_loops`."""
    grid = VoxelGrid.over(np.zeros(3), np.ones(3), torch.ones(2, 2, 2, dtype=torch.bool), contracted=False)
    one = torch.ones(1, 3) / 3**0.5
    rays = BoxRays(-one, one, one, torch.zeros(1), torch.full((1,), 9.0))
    march = March(1.0, 0.0, torch.ones(3), torch.zeros(1), smoothness=1.0)
    kernels = CpuVoxels(1)
    kernels.render(grid, rays, march)
    kernels.trace(grid, rays, march)
    kernels.accumulate(grid, rays, torch.zeros(1, 3), march)
    kernels.accumulate_depths(grid, rays, torch.zeros(1), march)
    kernels.mark(grid, rays, march, 0.5)
    kernels.resample(grid, grid, 0, grid.brick_count)
    spare = torch.zeros(len(grid.rows), len(PARTS)), torch.zeros_like(grid.rows)
    kernels.update(grid, *spare, Adam(0.1, 0.1, 0.1, 0.1, 0.9, 1.0, 1e-4, 0.25, 1.0))
    index, pair = torch.zeros(1, dtype=torch.long), torch.ones(1, 2, dtype=torch.float64)
    lens, c2w = torch.zeros(1, 9, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None, :3]
    fast_rays(index, pair, pair, pair, lens, c2w, 1.0, 2.0)
    for pixels in (np.zeros((1, 3), np.uint8), np.zeros((1, 3), np.uint16)):
        photo_colors(index, torch.zeros(1, 2, dtype=torch.long), index + 1, index, pixels)
