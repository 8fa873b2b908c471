"""The loops of the voxel grid for a CPU that choose its cells: which ones are needed, and the rows of a new grid.

The plain reference is `nerf_core.kernels.torch_voxels`. `grid` is what `VoxelGrid.arrays()` returns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import gather, jit
from nerf_core.kernels.numba_march import ALPHA, BLUE, GREEN, NOTES, RAW, RED, TRANSMITTANCE
from nerf_core.kernels.numba_voxels import sample

F = np.float32
HALVINGS = 24  # that of `voxel_kernels`, written out for the reason that `numba_voxels` gives


@jit
def mark(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any, marks: Any, spare: Any,
) -> None:  # fmt: skip
    """Mark the cells that the pixels of rays first ≤ r < last need; see `VoxelKernels.mark`."""
    sums = np.zeros(HALVINGS + 1, np.float32)
    corners, notes = scratch.corners, scratch.notes
    for r in range(first, last):
        n = sample(grid, rays, r, step, bias, rows, background, scratch, rows, False, pixel)
        sums[:] = 0
        through = F(1) - pixel[r, 3]
        for q in range(n):
            at = q * NOTES
            transmittance, alpha = notes[at + TRANSMITTANCE], notes[at + ALPHA]
            off = max(
                abs(notes[at + RED] - background[0]), abs(notes[at + GREEN] - background[1]),
                abs(notes[at + BLUE] - background[2]),
            )  # fmt: skip
            plain = min(through / max(transmittance * (F(1) - alpha), F(1e-12)), F(1))
            w = transmittance * alpha * (F(1) - plain + plain * off)
            h = _halvings(w)
            notes[at + RAW] = h
            sums[h] += w
        least, total = HALVINGS, sums[HALVINGS]  # the groups from `least` on are not needed
        while least > 0 and total + sums[least - 1] <= spare:
            least -= 1
            total += sums[least]
        for q in range(n):
            at = q * NOTES
            if notes[at + RAW] < least:  # marked at the cell's lowest vertex
                row = np.uint64(corners[at] >> 4)
                marks[row] = max(marks[row], np.uint8(1 + HALVINGS - np.int64(notes[at + RAW])))


@jit
def _halvings(w: Any) -> Any:
    """The h with 2⁻ʰ ≥ w > 2⁻ʰ⁻¹ (w ≤ 1), at most HALVINGS."""
    h, power = 0, F(0.5)
    while w <= power and h < HALVINGS:
        power *= F(0.5)
        h += 1
    return h


@jit
def resample(
    grid: Any, rows: Any, begin: Any, step: Any, places: Any, bricks: Any, first_row: Any, first: Any, last: Any,
    scratch: Any, out: Any, found: Any,
) -> None:  # fmt: skip
    """Interpolate rows for the vertices of `bricks` first ≤ b < last, which lie at `places` in their tables.

    Finest vertex v lies at begin + v · step, in finest cells of `grid`. Writes the rows from first_row on to `out`, and
    to `found` the doublings of the cells that were interpolated; see `VoxelKernels.resample`.
    """
    corners, weights, values = scratch.corners, scratch.weights, scratch.values
    for b in range(first, last):
        for q in range(64):
            row = np.int64(bricks[b, q >> 4, (q >> 2) & 3, q & 3]) - first_row
            if row < 0:
                continue
            x = _snapped(begin[0] + step[0] * (((places[b, 1] << 2) + (q >> 4)) << places[b, 0]))
            y = _snapped(begin[1] + step[1] * (((places[b, 2] << 2) + ((q >> 2) & 3)) << places[b, 0]))
            z = _snapped(begin[2] + step[2] * (((places[b, 3] << 2) + (q & 3)) << places[b, 0]))
            most, best = -1.0, 0
            for k in range(-2, len(grid.begins)):
                d = places[b, 0] + k + 1 if k < 0 else k
                if d < 0 or d >= len(grid.begins):
                    continue
                held = _lookup(grid, d, x, y, z, corners, weights)
                if held > most + 1e-6:
                    most, best = held, d
            _lookup(grid, best, x, y, z, corners, weights)
            gather(values, 0, rows, corners, weights, 0)
            found[row] = best
            for c in range(16):
                out[16 * row + c] = values[c]


@jit
def _snapped(x: Any) -> Any:
    """x, or the nearest multiple of 2⁻¹⁰ if rounding may have moved it away from there."""
    nearest = math.floor(x * 1024 + 0.5) / 1024
    return nearest if abs(x - nearest) < 1e-6 else x


@jit
def _lookup(grid: Any, d: Any, x: Any, y: Any, z: Any, corners: Any, weights: Any) -> Any:
    """The corners and weights at a point among cells of d doublings; returns the weight of those that have a row."""
    share = 1.0 / (1 << d)
    x, y, z = x * share, y * share, z * share
    i = min(max(math.floor(x), 0), ((grid.size[0] + (1 << d) - 1) >> d) - 1)
    j = min(max(math.floor(y), 0), ((grid.size[1] + (1 << d) - 1) >> d) - 1)
    k = min(max(math.floor(z), 0), ((grid.size[2] + (1 << d) - 1) >> d) - 1)
    fx, fy, fz = F(min(max(x - i, 0.0), 1.0)), F(min(max(y - j, 0.0), 1.0)), F(min(max(z - k, 0.0), 1.0))
    begin, ny, nz = grid.begins[d], grid.sides[d, 0], grid.sides[d, 1]
    held = 0.0
    for c in range(8):
        u, v, w = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
        brick = np.int64(grid.table[begin + ((u >> 2) * ny + (v >> 2)) * nz + (w >> 2)])
        row = np.int64(grid.bricks[125 * brick + 25 * (u & 3) + 5 * (v & 3) + (w & 3)])
        weight = (fx if c & 4 else F(1) - fx) * (fy if c & 2 else F(1) - fy) * (fz if c & 1 else F(1) - fz)
        corners[c], weights[c] = 16 * max(row, 0), weight if row >= 0 else F(0)
        held += weights[c]
    return held
