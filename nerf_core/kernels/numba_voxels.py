"""The hot loops of the voxel grid for a CPU: march, interpolate, composite, and the backward pass, in one function.

The plain reference is `nerf_core.kernels.torch_voxels`. `grid` is what `VoxelGrid.arrays()` returns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import exp, gather, jit, prefetch, scatter, scatter_smooth
from nerf_core.kernels.numba_march import (
    ALPHA,
    BLUE,
    CELL_X,
    CELL_Y,
    CELL_Z,
    DISTANCE,
    GREEN,
    NOTES,
    RAW,
    RED,
    TRANSMITTANCE,
    WIDTH,
    X,
    Y,
    Z,
    march,
)  # fmt: skip

F = np.float32
# The values of `nerf_core.volume`, written out: compiled loops are cached, and the cache's key contains only files with
# loops, so that a change elsewhere would not be compiled.
STOP = F(1e-3)  # that of `compositing`
SH0, SH1 = F(0.28209479), F(0.48860251)  # those of `voxel_grid`


@jit
def find_corners(i: Any, j: Any, k: Any, ny: Any, nz: Any, table: Any, begin: Any, corners: Any, at: Any) -> None:
    """The offsets in `rows` of the 8 vertices of cell (i, j, k), z fastest.

    begin: where the table of the cell's size begins in `table`. ny, nz: its bricks along y and z.
    """
    li, lj, lk = i & 3, j & 3, k & 3
    if li < 3 and lj < 3 and lk < 3:  # all in one brick
        base = np.int64(table[np.uint64(begin + ((i >> 2) * ny + (j >> 2)) * nz + (k >> 2))])
        row = (base * 64 + (li << 4) + (lj << 2) + lk) << 4
        corners[at] = row
        corners[at + 1] = row + 16
        corners[at + 2] = row + 64
        corners[at + 3] = row + 80
        corners[at + 4] = row + 256
        corners[at + 5] = row + 272
        corners[at + 6] = row + 320
        corners[at + 7] = row + 336
        return
    for c in range(8):
        a, b, d = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
        base = np.int64(table[np.uint64(begin + ((a >> 2) * ny + (b >> 2)) * nz + (d >> 2))])
        corners[at + c] = (base * 64 + ((a & 3) << 4) + ((b & 3) << 2) + (d & 3)) << 4


@jit
def weigh(fx: Any, fy: Any, fz: Any, weights: Any, at: Any) -> None:
    """Trilinear weights of the 8 corners, z fastest, of a point at (fx, fy, fz) in its cell."""
    hx, hy, hz = F(1) - fx, F(1) - fy, F(1) - fz
    weights[at] = hx * hy * hz
    weights[at + 1] = hx * hy * fz
    weights[at + 2] = hx * fy * hz
    weights[at + 3] = hx * fy * fz
    weights[at + 4] = fx * hy * hz
    weights[at + 5] = fx * hy * fz
    weights[at + 6] = fx * fy * hz
    weights[at + 7] = fx * fy * fz


@jit
def place_samples(grid: Any, n: Any, rows: Any, corners: Any, weights: Any, notes: Any) -> None:
    """Compute the corners and weights of n samples, and prefetch their rows."""
    bricks_y, bricks_z = grid.sides[0, 0], grid.sides[0, 1]
    for s in range(n):
        at = s * NOTES
        i, j, k = int(notes[at + CELL_X]), int(notes[at + CELL_Y]), int(notes[at + CELL_Z])
        d = i >> 12
        if d == 0:
            find_corners(i, j, k, bricks_y, bricks_z, grid.table, np.int64(0), corners, at)
        else:
            i -= d << 12
            find_corners(i, j, k, grid.sides[d, 0], grid.sides[d, 1], grid.table, grid.begins[d], corners, at)
        prefetch(rows, corners, at)
        weigh(notes[at + X], notes[at + Y], notes[at + Z], weights, at)


@jit
def composite(
    n: Any, basis: Any, step: Any, bias: Any, rows: Any, corners: Any, weights: Any, values: Any, notes: Any,
    gradient: Any, train: Any, pixel: Any, r: Any, background: Any,
) -> Any:  # fmt: skip
    """Composite up to n samples, until the transmittance is below STOP.

    Writes colour, opacity and Σ w t of pixel r. Returns how many samples it used.
    """
    transmittance = F(1)
    red, green, blue, far = F(0), F(0), F(0), F(0)
    y0, y1, y2, y3 = basis[0], basis[1], basis[2], basis[3]
    used = n
    for s in range(n):
        at = s * 8
        gather(values, 0, rows, corners, weights, at)
        raw = values[12] + bias
        sigma = raw if raw > F(15) else F(math.log(F(1) + exp(raw)))
        left = exp(-sigma * step)
        r0 = y0 * values[0] + y1 * values[1] + y2 * values[2] + y3 * values[3]
        g0 = y0 * values[4] + y1 * values[5] + y2 * values[6] + y3 * values[7]
        b0 = y0 * values[8] + y1 * values[9] + y2 * values[10] + y3 * values[11]
        r1, g1, b1 = F(1) / (F(1) + exp(-r0)), F(1) / (F(1) + exp(-g0)), F(1) / (F(1) + exp(-b0))
        w = transmittance * (F(1) - left)
        red += w * r1
        green += w * g1
        blue += w * b1
        far += w * notes[at + DISTANCE]
        notes[at + ALPHA] = F(1) - left
        notes[at + TRANSMITTANCE] = transmittance
        notes[at + RED] = r1
        notes[at + GREEN] = g1
        notes[at + BLUE] = b1
        notes[at + RAW] = raw
        if train:
            prefetch(gradient, corners, at)
        transmittance *= left
        if transmittance < STOP:
            used = s + 1
            break
    pixel[r, 0] = red + transmittance * background[0]
    pixel[r, 1] = green + transmittance * background[1]
    pixel[r, 2] = blue + transmittance * background[2]
    pixel[r, 3] = F(1) - transmittance
    pixel[r, 4] = far
    return used


@jit
def set_basis(views: Any, r: Any, basis: Any) -> None:
    basis[0] = SH0
    basis[1] = SH1 * views[r, 1]
    basis[2] = SH1 * views[r, 2]
    basis[3] = SH1 * views[r, 0]


@jit
def render(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any,
) -> None:  # fmt: skip
    """Write pixel[r] = (colour, opacity, Σ w t) for first ≤ r < last."""
    basis = scratch.values[48:52]
    for r in range(first, last):
        n = march(grid, rays, r, step, scratch.notes)
        place_samples(grid, n, rows, scratch.corners, scratch.weights, scratch.notes)
        set_basis(rays.views, r, basis)
        composite(
            n, basis, step, bias, rows, scratch.corners, scratch.weights, scratch.values, scratch.notes, rows, False,
            pixel, r, background,
        )  # fmt: skip


@jit
def trace(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any, kept: Any, counts: Any,
) -> Any:  # fmt: skip
    """Render, and copy the notes of the samples to `kept` up to its capacity; returns how many samples there are."""
    basis = scratch.values[48:52]
    total = 0
    for r in range(first, last):
        n = march(grid, rays, r, step, scratch.notes)
        place_samples(grid, n, rows, scratch.corners, scratch.weights, scratch.notes)
        set_basis(rays.views, r, basis)
        n = composite(
            n, basis, step, bias, rows, scratch.corners, scratch.weights, scratch.values, scratch.notes, rows, False,
            pixel, r, background,
        )  # fmt: skip
        counts[r] = n
        for s in range(min(n, kept.shape[0] - total)):
            for q in range(NOTES):
                kept[total + s, q] = scratch.notes[s * NOTES + q]
        total += n
    return total


@jit
def _place_in_ray(t: Any, unit: Any, folded: Any) -> Any:
    """s in units of `unit`; folded: t/(t + 1) of it, so that all of space has a finite length."""
    t = t / unit
    return t / (F(1) + t) if folded else t


@jit
def gradients(
    grid: Any, rays: Any, truth: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any,
    scratch: Any, pixel: Any, gradient: Any, touched: Any, smoothness: Any, distortion: Any, unit: Any, folded: Any,
) -> Any:  # fmt: skip
    """Add ∂(½ Σ squared error + smoothness + distortion)/∂rows of rays first ≤ r < last to `gradient`; see `March`.

    Returns the sum of squared errors, and the number of samples.

    A loss with ∂L/∂w_i = a_i beside the colours acts like one more channel with the colours a_i and no background, so
    that it is added to what an error takes from the colours. For distortion, with weights and positions summed in
    front of sample i (−) and behind it (+):
    a_i = λ (2 (s_i (W⁻ − W⁺) − (S⁻ − S⁺)) + ⅔ w_i Δs_i), W = Σ w, S = Σ w s.
    With S_i = Σ_{j>i} w_j c_j + T_end · background, ∂C/∂σ_i = δ_i (T_{i+1} c_i − S_i): NeRF Eq. 3, differentiated.
    """
    basis = scratch.values[48:52]
    corners, weights, values, notes = scratch.corners, scratch.weights, scratch.values, scratch.notes
    for q in range(16):
        values[32 + q] = smoothness if q == 12 else F(0)
    error = 0.0
    samples = 0
    for r in range(first, last):
        n = march(grid, rays, r, step, notes)
        place_samples(grid, n, rows, corners, weights, notes)
        set_basis(rays.views, r, basis)
        n = composite(n, basis, step, bias, rows, corners, weights, values, notes, gradient, True, pixel, r, background)
        samples += n
        er, eg, eb = pixel[r, 0] - truth[r, 0], pixel[r, 1] - truth[r, 1], pixel[r, 2] - truth[r, 2]
        error += er * er + eg * eg + eb * eb
        behind = (F(1) - pixel[r, 3]) * (background[0] * er + background[1] * eg + background[2] * eb)
        w_behind, s_behind, w_front, s_front = F(0), F(0), F(0), F(0)
        if distortion > 0:
            for q in range(n):
                at = q * 8
                w = notes[at + TRANSMITTANCE] * notes[at + ALPHA]
                w_front += w
                s_front += w * _place_in_ray(notes[at + DISTANCE], unit, folded)
        for q in range(n):
            at = (n - 1 - q) * 8
            r1, g1, b1 = notes[at + RED], notes[at + GREEN], notes[at + BLUE]
            transmittance, alpha = notes[at + TRANSMITTANCE], notes[at + ALPHA]
            w, along = transmittance * alpha, r1 * er + g1 * eg + b1 * eb
            if distortion > 0:
                place = _place_in_ray(notes[at + DISTANCE], unit, folded)
                width = notes[at + WIDTH] / unit
                if folded:
                    width *= (F(1) - place) * (F(1) - place)
                w_front -= w
                s_front -= w * place
                along += distortion * (
                    F(2) * (place * (w_front - w_behind) - (s_front - s_behind)) + F(2 / 3) * w * width
                )
                w_behind += w
                s_behind += w * place
            by_sigma = step * (transmittance * (F(1) - alpha) * along - behind)
            behind += w * along
            gr, gg, gb = w * er * r1 * (F(1) - r1), w * eg * g1 * (F(1) - g1), w * eb * b1 * (F(1) - b1)
            for c in range(4):
                values[16 + c] = gr * basis[c]
                values[20 + c] = gg * basis[c]
                values[24 + c] = gb * basis[c]
            values[28] = by_sigma / (F(1) + exp(-notes[at + RAW]))  # softplus' is the sigmoid
            if smoothness > 0:
                scatter_smooth(gradient, corners, weights, at, values, 16, rows, 32)
            else:
                scatter(gradient, corners, weights, at, values, 16)
            for c in range(8):
                row = np.uint64(corners[at + c] >> 4)
                touched[row >> np.uint64(6)] |= np.uint64(1) << (row & np.uint64(63))
    return error, samples


@jit
def adam(
    first: Any, last: Any, rows: Any, moments: Any, ema: Any, gradient: Any, touched: Any,
    rate_color: Any, rate_view: Any, rate_density: Any, beta1: Any, beta2: Any, correction1: Any, correction2: Any,
    epsilon: Any, ema_rate: Any,
) -> None:  # fmt: skip
    """One step of Adam on the touched rows of bricks first ≤ b < last, and of the rows' EMA.

    Gradients, one array a shard, are summed and cleared. The colour coefficients of a row share one second moment. It
    is stored in the padding of the first moments, as density's is: this halves memory and memory traffic.
    """
    shards = touched.shape[0]
    for b in range(first, last):
        mask = np.uint64(0)
        for s in range(shards):
            mask |= touched[s, b]
            touched[s, b] = 0
        if mask == 0:
            continue
        for q in range(64):
            if (mask >> np.uint64(q)) & np.uint64(1) == 0:
                continue
            at = (b * 64 + q) * 16
            p, m, g = rows[at : at + 16], moments[at : at + 16], gradient[0, at : at + 16]
            for s in range(1, shards):
                other = gradient[s, at : at + 16]
                for c in range(16):
                    g[c] += other[c]
                    other[c] = 0
            square = F(0)
            for c in range(12):
                square += g[c] * g[c]
            v_color = beta2 * m[14] + (F(1) - beta2) * square * F(1 / 12)
            v_density = beta2 * m[15] + (F(1) - beta2) * g[12] * g[12]
            by_color = rate_color * correction1 / (math.sqrt(v_color * correction2) + epsilon)
            by_view = rate_view * correction1 / (math.sqrt(v_color * correction2) + epsilon)
            by_density = rate_density * correction1 / (math.sqrt(v_density * correction2) + epsilon)
            for c in range(13):
                m[c] = beta1 * m[c] + (F(1) - beta1) * g[c]
            for c in range(12):
                p[c] -= (by_view if c & 3 else by_color) * m[c]  # the first of four is of degree 0
            p[12] -= by_density * m[12]
            m[14], m[15] = v_color, v_density
            a = ema[at : at + 16]
            for c in range(13):
                a[c] += ema_rate * (p[c] - a[c])
            for c in range(16):
                g[c] = 0
