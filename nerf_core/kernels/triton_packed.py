"""`PackedKernels` on CUDA through Triton: launches of `nerf_core.kernels.triton_loops`; the march is torch's yet."""

from __future__ import annotations

from typing import Any

import torch
import triton
from torch import Tensor

from nerf_core.kernels import triton_loops
from nerf_core.kernels.packed_kernels import BETA1, BETA2, EPSILON, HashLevels, Samples
from nerf_core.kernels.torch_packed import TorchPacked

loops: Any = triton_loops  # what Triton types as a call is a launch, with other arguments
POINTS, RAYS, ROWS = 128, 64, 256  # one program's share


class TritonPacked(TorchPacked):
    """What Triton does not do faster is inherited."""

    name = "triton"

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        count, rows, width = table.shape
        features = torch.empty(len(x), count * width, device=x.device)
        if len(x):
            grid = (triton.cdiv(len(x), POINTS), count)
            loops.encode[grid](
                x.contiguous(), table, _resolutions(levels, x), features, len(x), rows, count, WIDTH=width,
                BLOCK=POINTS,
            )  # fmt: skip
        return features

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        count, rows, width = into.shape
        if len(x):
            grid = (triton.cdiv(len(x), POINTS), count)
            loops.encode_gradient[grid](
                x.contiguous(), gradient.contiguous(), _resolutions(levels, x), into, len(x), rows, count, WIDTH=width,
                BLOCK=POINTS,
            )  # fmt: skip

    def composite(self, tau: Tensor, rgb: Tensor, samples: Samples, background: Tensor) -> Tensor:
        count = len(samples.ends) - 1
        pixel = torch.empty(count, 5, device=tau.device)
        given = (v.contiguous() for v in (tau, rgb, samples.t, samples.ends, background))
        loops.composite[(triton.cdiv(count, RAYS),)](*given, pixel, count, BLOCK=RAYS)
        return pixel

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Samples, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        count = len(samples.ends) - 1
        by_tau, by_rgb = torch.empty_like(tau), torch.empty_like(rgb)
        given = (v.contiguous() for v in (gradient, tau, rgb, samples.ends, background))
        loops.composite_gradient[(triton.cdiv(count, RAYS),)](*given, by_tau, by_rgb, count, BLOCK=RAYS)
        return by_tau, by_rgb

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rate: float, step: int) -> None:
        count, width = table.numel() // table.shape[-1], table.shape[-1]
        loops.adam[(triton.cdiv(count, ROWS),)](
            table, gradient, *moments, count, rate, 1 / (1 - BETA1**step), 1 / (1 - BETA2**step), EPSILON,
            BETA1=BETA1, BETA2=BETA2, WIDTH=width, BLOCK=ROWS,
        )  # fmt: skip


def _resolutions(levels: HashLevels, x: Tensor) -> Tensor:
    return torch.tensor(levels.resolutions, dtype=torch.int32, device=x.device)
