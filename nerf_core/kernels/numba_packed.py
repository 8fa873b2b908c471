"""The hot loops of packed samples and the hash grid for a CPU. Reference: `nerf_core.kernels.torch_packed`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import exp, jit
from nerf_core.kernels.numba_march import (
    CELL_X,
    CELL_Y,
    CELL_Z,
    DISTANCE,
    NOTES,
    WIDTH,
    X,
    Y,
    Z,
    march,
)  # fmt: skip

F = np.float32
P1, P2 = np.uint32(2654435761), np.uint32(805459861)


@jit
def march_all(
    cells: Any, rays: Any, first: Any, last: Any, step: Any, notes: Any, x: Any, t: Any, width: Any, counts: Any
) -> Any:
    """Find the samples of rays first ≤ r < last, ray after ray; returns how many. Stops early when x is full."""
    nx, ny, nz = F(cells.size[0]), F(cells.size[1]), F(cells.size[2])
    at = 0
    for r in range(first, last):
        n = min(march(cells, rays, r, step, notes), x.shape[0] - at)
        counts[r] = n
        for s in range(n):
            q = s * NOTES
            x[at, 0] = (notes[q + CELL_X] + notes[q + X]) / nx
            x[at, 1] = (notes[q + CELL_Y] + notes[q + Y]) / ny
            x[at, 2] = (notes[q + CELL_Z] + notes[q + Z]) / nz
            t[at], width[at] = notes[q + DISTANCE], notes[q + WIDTH]
            at += 1
    return at


@jit
def _corners(x: Any, m: Any, n: Any, mask: Any, dense: Any, rows: Any, weights: Any) -> None:
    """Rows and trilinear weights of the 8 vertices around point m on a level of n cells a side."""
    px, py, pz = x[m, 0] * F(n), x[m, 1] * F(n), x[m, 2] * F(n)
    i, j, k = min(int(px), n - 1), min(int(py), n - 1), min(int(pz), n - 1)
    fx, fy, fz = px - F(i), py - F(j), pz - F(k)
    hx, hy, hz = F(1) - fx, F(1) - fy, F(1) - fz
    weights[0], weights[1] = hx * hy * hz, hx * hy * fz
    weights[2], weights[3] = hx * fy * hz, hx * fy * fz
    weights[4], weights[5] = fx * hy * hz, fx * hy * fz
    weights[6], weights[7] = fx * fy * hz, fx * fy * fz
    if dense:
        side = n + 1
        row = (i * side + j) * side + k
        rows[0], rows[1] = row, row + 1
        rows[2], rows[3] = row + side, row + side + 1
        row += side * side
        rows[4], rows[5] = row, row + 1
        rows[6], rows[7] = row + side, row + side + 1
    else:
        u, v, w = np.uint32(i), np.uint32(j) * P1, np.uint32(k) * P2
        a, b, c = u + np.uint32(1), v + P1, w + P2
        rows[0], rows[1] = np.int64((u ^ v ^ w) & mask), np.int64((u ^ v ^ c) & mask)
        rows[2], rows[3] = np.int64((u ^ b ^ w) & mask), np.int64((u ^ b ^ c) & mask)
        rows[4], rows[5] = np.int64((a ^ v ^ w) & mask), np.int64((a ^ v ^ c) & mask)
        rows[6], rows[7] = np.int64((a ^ b ^ w) & mask), np.int64((a ^ b ^ c) & mask)


@jit
def encode(table: Any, resolutions: Any, x: Any, first: Any, last: Any, features: Any) -> None:
    """Write the features of points first ≤ m < last, level by level, so that one level's table stays in the cache."""
    levels, size, width = table.shape
    mask = np.uint32(size - 1)
    rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
    for level in range(levels):
        n = resolutions[level]
        dense = (n + 1) * (n + 1) * (n + 1) <= size
        base = level * width
        for m in range(first, last):
            _corners(x, m, n, mask, dense, rows, weights)
            if width == 4:  # four floats in one register
                a, b, c, d = F(0), F(0), F(0), F(0)
                for q in range(8):
                    w, row = weights[q], np.uint64(rows[q])
                    a += w * table[level, row, 0]
                    b += w * table[level, row, 1]
                    c += w * table[level, row, 2]
                    d += w * table[level, row, 3]
                features[m, base], features[m, base + 1] = a, b
                features[m, base + 2], features[m, base + 3] = c, d
            else:
                for f in range(width):
                    total = F(0)
                    for q in range(8):
                        total += weights[q] * table[level, np.uint64(rows[q]), f]
                    features[m, base + f] = total


@jit
def encode_gradient(gradient: Any, resolutions: Any, x: Any, first: Any, last: Any, into: Any) -> None:
    """Add to the gradient of the levels first ≤ l < last. Each level belongs to one shard, so that there is no race."""
    _, size, width = into.shape
    mask = np.uint32(size - 1)
    rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
    for level in range(first, last):
        n = resolutions[level]
        dense = (n + 1) * (n + 1) * (n + 1) <= size
        base = level * width
        for m in range(x.shape[0]):
            _corners(x, m, n, mask, dense, rows, weights)
            if width == 4:
                a, b, c, d = gradient[m, base], gradient[m, base + 1], gradient[m, base + 2], gradient[m, base + 3]
                for q in range(8):
                    w, row = weights[q], np.uint64(rows[q])
                    into[level, row, 0] += w * a
                    into[level, row, 1] += w * b
                    into[level, row, 2] += w * c
                    into[level, row, 3] += w * d
            else:
                for q in range(8):
                    for f in range(width):
                        into[level, np.uint64(rows[q]), f] += weights[q] * gradient[m, base + f]


@jit
def composite(tau: Any, rgb: Any, t: Any, row_offsets: Any, background: Any, first: Any, last: Any, pixel: Any) -> None:
    for r in range(first, last):
        transmittance, red, green, blue, far = F(1), F(0), F(0), F(0), F(0)
        for s in range(row_offsets[r], row_offsets[r + 1]):
            left = exp(-tau[s])
            w = transmittance * (F(1) - left)
            red += w * rgb[s, 0]
            green += w * rgb[s, 1]
            blue += w * rgb[s, 2]
            far += w * t[s]
            transmittance *= left
        pixel[r, 0] = red + transmittance * background[0]
        pixel[r, 1] = green + transmittance * background[1]
        pixel[r, 2] = blue + transmittance * background[2]
        pixel[r, 3] = F(1) - transmittance
        pixel[r, 4] = far


@jit
def composite_gradient(
    gradient: Any,
    tau: Any,
    rgb: Any,
    row_offsets: Any,
    background: Any,
    first: Any,
    last: Any,
    by_tau: Any,
    by_rgb: Any,
) -> None:
    """∂C/∂τ_i = T_{i+1} c_i − S_i with S_i = Σ_{j>i} w_j c_j + T_end · background.

    One pass from the front computes T, one from the back S.
    """
    for r in range(first, last):
        gr, gg, gb = gradient[r, 0], gradient[r, 1], gradient[r, 2]
        transmittance = F(1)
        for s in range(row_offsets[r], row_offsets[r + 1]):
            left = exp(-tau[s])
            w = transmittance * (F(1) - left)
            by_rgb[s, 0], by_rgb[s, 1], by_rgb[s, 2] = w * gr, w * gg, w * gb
            transmittance *= left
            by_tau[s] = transmittance  # T_{i+1}, for the pass from the back
        behind = transmittance * (background[0] * gr + background[1] * gg + background[2] * gb)
        for q in range(row_offsets[r + 1] - row_offsets[r]):
            s = row_offsets[r + 1] - 1 - q
            by_tau[s] = by_tau[s] * (rgb[s, 0] * gr + rgb[s, 1] * gg + rgb[s, 2] * gb) - behind
            behind += by_rgb[s, 0] * rgb[s, 0] + by_rgb[s, 1] * rgb[s, 1] + by_rgb[s, 2] * rgb[s, 2]


@jit
def adam(
    table: Any, gradient: Any, mean: Any, square: Any, first: Any, last: Any, rate: Any, correction1: Any,
    correction2: Any, beta1: Any, beta2: Any, epsilon: Any,
) -> None:  # fmt: skip
    """One step of Adam on the rows first ≤ r < last that have a gradient; the gradient is then cleared."""
    width = table.shape[1]
    for r in range(first, last):
        some = F(0)
        for f in range(width):
            some += abs(gradient[r, f])
        if some == 0:
            continue
        for f in range(width):
            g = gradient[r, f]
            m = beta1 * mean[r, f] + (F(1) - beta1) * g
            v = beta2 * square[r, f] + (F(1) - beta2) * g * g
            mean[r, f], square[r, f] = m, v
            table[r, f] -= rate * (m * correction1) / (math.sqrt(v * correction2) + epsilon)
            gradient[r, f] = F(0)
