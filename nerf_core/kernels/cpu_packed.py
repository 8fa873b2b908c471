"""Packed samples and the hash grid on a CPU: numba's loops, run over shards in threads.

Rays, points and levels are divided into shards by position, and no two shards write to the same place. So the results
depend neither on timing nor on the number of shards.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.jit.shards import each_shard, shards_of, split
from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels import numba_packed as loops
from nerf_core.kernels.cpu_rays import ray_arrays
from nerf_core.kernels.numba_march import NOTES
from nerf_core.kernels.packed_kernels import BETA1, BETA2, EPSILON, BoxSamples, HashLevels, adam_numbers
from nerf_core.volume.cells import Cells
from nerf_core.volume.packed import Packed


class CpuPacked:
    """`PackedKernels` through numba."""

    name = "numba"
    fixed_shapes = False

    def __init__(self, shards: int) -> None:
        self.shards = shards
        self._average = 32.0  # samples a ray, from which the next march's capacity is chosen; at first a guess

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor, capacity: int = 0) -> BoxSamples:
        arrays, given = cells.cell_arrays(), ray_arrays(rays, offsets)
        longest = int(1.5 * sum(cells.size) / step) + 8  # as in `cpu_voxels`
        counts = torch.zeros(len(rays), dtype=torch.long)
        shards = shards_of(len(rays), self.shards)
        parts: list[tuple[Tensor, ...]] = [()] * shards

        def work(s: int) -> None:
            first, last = split(len(rays), shards, s)
            notes = torch.empty(longest * NOTES).numpy()
            capacity = int(2 * self._average * (last - first)) + longest
            while True:
                x, t, width = torch.empty(capacity, 3), torch.empty(capacity), torch.empty(capacity)
                found = loops.march_all(
                    arrays, given, first, last, np.float32(step), notes, x.numpy(), t.numpy(), width.numpy(),
                    counts.numpy(),
                )  # fmt: skip
                if found < capacity:
                    break
                capacity *= 2
            parts[s] = x[:found], t[:found], width[:found]

        each_shard(shards, work)
        x, t, width = (torch.cat(v) for v in zip(*parts, strict=True))
        self._average = max(1.0, len(t) / max(1, len(rays)))
        samples = BoxSamples(torch.cat([counts.new_zeros(1), counts.cumsum(0)]), t, width, x)
        return samples.fitted(capacity) if capacity else samples

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        features = torch.empty(len(x), table.shape[0] * table.shape[2])
        given = table.numpy(), np.array(levels.resolutions), x.contiguous().numpy()
        out, shards = features.numpy(), shards_of(len(x), self.shards)
        each_shard(shards, lambda s: loops.encode(*given, *split(len(x), shards, s), out))
        return features

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        given = gradient.contiguous().numpy(), np.array(levels.resolutions), x.contiguous().numpy()
        out, count = into.numpy(), len(levels.resolutions)
        each_shard(self.shards, lambda s: loops.encode_gradient(*given, *split(count, self.shards, s), out))

    def composite(self, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor) -> Tensor:
        count = len(samples.row_offsets) - 1
        pixel = torch.empty(count, 5)
        given = [v.contiguous().numpy() for v in (tau, rgb, samples.t, samples.row_offsets, background)]
        out, shards = pixel.numpy(), shards_of(count, self.shards)
        each_shard(shards, lambda s: loops.composite(*given, *split(count, shards, s), out))
        return pixel

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        count = len(samples.row_offsets) - 1
        by_tau, by_rgb = torch.zeros_like(tau), torch.zeros_like(rgb)  # samples behind the last ray have no gradient
        given = [v.contiguous().numpy() for v in (gradient, tau, rgb, samples.row_offsets, background)]
        out = by_tau.numpy(), by_rgb.numpy()
        each_shard(self.shards, lambda s: loops.composite_gradient(*given, *split(count, self.shards, s), *out))
        return by_tau, by_rgb

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], numbers: Tensor) -> None:
        width = table.shape[-1]
        given = [v.view(-1, width).numpy() for v in (table, gradient, *moments)]
        count, settings = len(given[0]), [np.float32(v) for v in (*numbers.tolist(), BETA1, BETA2, EPSILON)]
        each_shard(self.shards, lambda s: loops.adam(*given, *split(count, self.shards, s), *settings))


def call_each() -> None:
    """Call each of the loops once; for `compile_loops`."""
    cells = Cells.of(np.zeros(3), np.ones(3), torch.ones(2, 2, 2, dtype=torch.bool), contracted=False)
    one = torch.ones(1, 3) / 3**0.5
    rays = BoxRays(-one, one, one, torch.zeros(1), torch.full((1,), 9.0))
    kernels, levels = CpuPacked(1), HashLevels((2, 9))
    samples = kernels.march(cells, rays, 1.0, torch.zeros(1))
    table = torch.zeros(2, 64, 4)
    features = kernels.encode(table, levels, samples.x)
    kernels.encode_gradient(features, levels, samples.x, table)
    tau, rgb = torch.ones_like(samples.t), torch.ones(len(samples.t), 3)
    kernels.composite(tau, rgb, samples, torch.ones(3))
    kernels.composite_gradient(torch.ones(1, 3), tau, rgb, samples, torch.ones(3))
    kernels.adam(table, table.clone(), (table.clone(), table.clone()), adam_numbers(1.0, 1))
