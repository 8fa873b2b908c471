"""`PackedKernels` on CUDA: launches of the Triton kernels in `nerf_core.kernels.triton_loops`.

With a `capacity`, nothing here waits for the device or copies to it, so that a CUDA graph can record it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import triton
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels import triton_loops
from nerf_core.kernels.packed_kernels import BETA1, BETA2, EPSILON, BoxSamples, HashLevels
from nerf_core.volume.cells import Cells
from nerf_core.volume.packed import Packed

loops: Any = triton_loops  # a launch has other arguments than the call that type checkers see
POINTS, RAYS, ROWS = 128, 64, 256  # that one program works on
# No fused multiply-add. The march that counts samples and the march that writes them are compiled separately. If only
# one of them fused, they would find different numbers of samples. All kernels get the option: they are limited by
# memory, not by arithmetic.
EXACTLY = {"enable_fp_fusion": False}


class TritonPacked:
    """`PackedKernels` through Triton."""

    name = "triton"
    fixed_shapes = True

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor, capacity: int = 0) -> BoxSamples:
        count, device = len(rays), offsets.device
        given = [v.contiguous() for v in (rays.origins, rays.directions, rays.near, rays.far, offsets)]
        held = [v.contiguous() for v in (cells.kinds, cells.leap)]
        box = [float(v) for v in (*cells.origin, *(1 / cells.voxel))]

        def launch(row_offsets: Tensor, counts: Tensor, found: BoxSamples, write: bool) -> None:
            loops.march[(triton.cdiv(count, RAYS),)](
                *given, *held, row_offsets, counts, found.x, found.t, found.width, count, len(found.t), step, *box,
                *cells.size, CONTRACTED=cells.contracted, WRITE=write, BLOCK=RAYS, **EXACTLY,
            )  # fmt: skip

        counts = torch.zeros(count, dtype=torch.long, device=device)
        launch(counts, counts, _empty_samples(counts, 0), write=False)
        row_offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        found = _empty_samples(row_offsets, capacity or int(row_offsets[-1]))
        launch(row_offsets, counts, found, write=True)
        return BoxSamples(row_offsets.clamp(max=len(found.t)), found.t, found.width, found.x.clamp_(0, 1))

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        count, rows, width = table.shape
        features = torch.empty(len(x), count * width, device=x.device)
        if len(x):
            grid = (triton.cdiv(len(x), POINTS), count)
            loops.encode[grid](
                x.contiguous(), table, _resolutions(levels, x.device), features, len(x), rows, count, WIDTH=width,
                BLOCK=POINTS, **EXACTLY,
            )  # fmt: skip
        return features

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        count, rows, width = into.shape
        if len(x):
            grid = (triton.cdiv(len(x), POINTS), count)
            loops.encode_gradient[grid](
                x.contiguous(), gradient.contiguous(), _resolutions(levels, x.device), into, len(x), rows, count,
                WIDTH=width, BLOCK=POINTS, **EXACTLY,
            )  # fmt: skip

    def composite(self, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor) -> Tensor:
        count = len(samples.row_offsets) - 1
        pixel = torch.empty(count, 5, device=tau.device)
        given = (v.contiguous() for v in (tau, rgb, samples.t, samples.row_offsets, background))
        loops.composite[(triton.cdiv(count, RAYS),)](*given, pixel, count, BLOCK=RAYS, **EXACTLY)
        return pixel

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        count = len(samples.row_offsets) - 1
        by_tau, by_rgb = torch.zeros_like(tau), torch.zeros_like(rgb)  # samples behind the last ray have no gradient
        given = (v.contiguous() for v in (gradient, tau, rgb, samples.row_offsets, background))
        loops.composite_gradient[(triton.cdiv(count, RAYS),)](*given, by_tau, by_rgb, count, BLOCK=RAYS, **EXACTLY)
        return by_tau, by_rgb

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], numbers: Tensor) -> None:
        count, width = table.numel() // table.shape[-1], table.shape[-1]
        loops.adam[(triton.cdiv(count, ROWS),)](
            table, gradient, *moments, count, numbers, EPSILON, BETA1=BETA1, BETA2=BETA2, WIDTH=width, BLOCK=ROWS,
            **EXACTLY,
        )  # fmt: skip


def _empty_samples(row_offsets: Tensor, count: int) -> BoxSamples:
    return BoxSamples(
        row_offsets, *(torch.zeros(*shape, device=row_offsets.device) for shape in ((count,), (count,), (count, 3)))
    )


@lru_cache(maxsize=16)
def _resolutions(levels: HashLevels, device: torch.device) -> Tensor:
    return torch.tensor(levels.resolutions, dtype=torch.int32, device=device)
