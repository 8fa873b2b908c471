"""The voxel grid's loss of depth on a CPU. The plain reference is `TorchVoxels.accumulate_depths`."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import exp, jit, scatter
from nerf_core.kernels.numba_march import ALPHA, DISTANCE, NOTES, RAW, TRANSMITTANCE
from nerf_core.kernels.numba_voxels import note_rows, place_in_ray, sample

F = np.float32
OUTLIER = F(0.02)  # that of `voxel_kernels`, written out as in `numba_voxels`


@jit
def depth_gradients(
    grid: Any, rays: Any, depths: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any,
    scratch: Any, pixel: Any, gradient: Any, touched: Any, weight: Any, unit: Any, folded: Any,
) -> None:  # fmt: skip
    """Add the gradient of `VoxelKernels.accumulate_depths` of rays first ≤ r < last; their surfaces are at `depths`.

    ∂/∂w_i = a_i = 2λ clamp(Σ_j w_j s_j − s*) s_i, and ∂/∂σ_i = δ_i (T_{i+1} a_i − Σ_{j>i} w_j a_j); see `gradients` of
    `numba_voxels`.
    """
    corners, weights, values, notes = scratch.corners, scratch.weights, scratch.values, scratch.notes
    for r in range(first, last):
        n = sample(grid, rays, r, step, bias, rows, background, scratch, gradient, True, pixel)
        mean, behind = F(0), F(0)
        for q in range(n):
            at = q * NOTES
            mean += notes[at + TRANSMITTANCE] * notes[at + ALPHA] * place_in_ray(notes[at + DISTANCE], unit, folded)
        off = mean - place_in_ray(depths[r], unit, folded)
        pull = F(2) * weight * min(max(off, -OUTLIER), OUTLIER)
        for q in range(16):
            values[16 + q] = F(0)  # colour and gloss have no part in it
        for q in range(n):
            at = (n - 1 - q) * NOTES
            transmittance, alpha = notes[at + TRANSMITTANCE], notes[at + ALPHA]
            along = pull * place_in_ray(notes[at + DISTANCE], unit, folded)
            by_sigma = step * (transmittance * (F(1) - alpha) * along - behind)
            behind += transmittance * alpha * along
            values[28] = by_sigma / (F(1) + exp(-notes[at + RAW]))  # softplus' is the sigmoid
            corner = (n - 1 - q) * 8
            scatter(gradient, corners, weights, corner, values, 16)
            note_rows(touched, corners, corner)
