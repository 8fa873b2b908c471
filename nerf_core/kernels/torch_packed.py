"""Packed samples and the hash grid with torch operations: the plain reference for the fast kernels, on any device."""

from __future__ import annotations

import torch
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels.packed_kernels import BETA1, BETA2, EPSILON, PRIMES, BoxSamples, HashLevels
from nerf_core.kernels.torch_march import march
from nerf_core.volume.cells import Cells
from nerf_core.volume.packed import Packed


class TorchPacked:
    """`PackedKernels` in torch operations."""

    name = "torch"
    fixed_shapes = False

    def march(self, cells: Cells, rays: BoxRays, step: float, offsets: Tensor, capacity: int = 0) -> BoxSamples:
        found = march(cells, rays, step, offsets)
        counts = torch.bincount(found.ray, minlength=len(rays))
        row_offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        x = (found.cell + found.within) / torch.tensor(cells.size, device=row_offsets.device)
        samples = BoxSamples(row_offsets, found.t, found.width, x.clamp(0, 1))
        return samples.fitted(capacity) if capacity else samples

    def encode(self, table: Tensor, levels: HashLevels, x: Tensor) -> Tensor:
        features = []
        for level in range(len(levels.resolutions)):
            rows, weights = corners(levels, level, table.shape[1], x)
            features.append((weights[..., None] * table[level][rows]).sum(1))
        return torch.cat(features, -1)

    def encode_gradient(self, gradient: Tensor, levels: HashLevels, x: Tensor, into: Tensor) -> None:
        width = into.shape[2]
        for level in range(len(levels.resolutions)):
            rows, weights = corners(levels, level, into.shape[1], x)
            part = weights[..., None] * gradient[:, None, level * width : (level + 1) * width]
            into[level].index_add_(0, rows.flatten(), part.reshape(-1, width))

    def composite(self, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor) -> Tensor:
        ray, count = samples.ray, len(samples.row_offsets) - 1
        transmittance = torch.exp(-samples.before(tau)).to(tau.dtype)
        weight = transmittance * -torch.expm1(-tau)
        color = rgb.new_zeros(count, 3).index_add(0, ray, weight[:, None] * rgb)
        far = tau.new_zeros(count).index_add(0, ray, weight * samples.t)
        left = torch.exp(-tau.new_zeros(count).index_add(0, ray, tau))
        return torch.cat([color + left[:, None] * background, (1 - left)[:, None], far[:, None]], -1)

    def composite_gradient(
        self, gradient: Tensor, tau: Tensor, rgb: Tensor, samples: Packed, background: Tensor
    ) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaves = tau.detach().requires_grad_(), rgb.detach().requires_grad_()
            color = self.composite(*leaves, samples, background)[:, :3]
            by_tau, by_rgb = torch.autograd.grad(color, leaves, gradient)
        return by_tau, by_rgb

    def adam(self, table: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], numbers: Tensor) -> None:
        rate, correction1, correction2 = numbers
        touched = (gradient != 0).any(-1)
        g = gradient[touched]
        mean, square = (m[touched] for m in moments)
        mean, square = BETA1 * mean + (1 - BETA1) * g, BETA2 * square + (1 - BETA2) * g * g
        row = table[touched] - rate * (mean * correction1) / ((square * correction2).sqrt() + EPSILON)
        # all is computed before anything is written, because the device may run out of memory
        moments[0][touched], moments[1][touched], table[touched] = mean, square, row
        gradient.zero_()


def corners(levels: HashLevels, level: int, rows: int, x: Tensor) -> tuple[Tensor, Tensor]:
    """The 8 vertices around points on a level.

    rows: of the level's table. x: points (M, 3) in [0, 1].
    Returns their rows in the table (M, 8), and their trilinear weights (M, 8).
    """
    n = levels.resolutions[level]
    at = x * n
    cell = at.floor().long().clamp(0, n - 1)
    within = (at - cell)[:, None]
    corner = torch.cartesian_prod(*[torch.arange(2, device=x.device)] * 3)
    i, j, k = (cell[:, None] + corner).unbind(-1)
    if levels.dense(level, rows):
        row = (i * (n + 1) + j) * (n + 1) + k
    else:
        row = (i * PRIMES[0] ^ j * PRIMES[1] ^ k * PRIMES[2]) & (rows - 1)
    return row, torch.where(corner == 1, within, 1 - within).prod(-1)
