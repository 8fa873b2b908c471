"""The hot loops of the voxel grid for a CPU: march, interpolate, composite, and the backward pass, in one function.

The plain reference is `nerf_core.kernels.torch_voxels`. `grid` is what `VoxelGrid.arrays()` returns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import exp, gather_dots, inlined, jit, log, place, prefetch, scatter, scatter_smooth
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
    advance,
    enter,
)  # fmt: skip
from nerf_core.kernels.numba_turn import TURN_RAYS, add_turn, rise, touch

F = np.float32
# The values of `nerf_core.volume`, written out: compiled loops are cached, and the cache's key contains only files with
# loops, so that a change elsewhere would not be compiled.
STOP = F(1e-3)  # that of `compositing`
CLEAR, OPAQUE, CALM = F(0.12), F(0.1), F(2.5e-9)  # those of `voxel_kernels`
SH0, SH1 = F(0.28209479), F(0.48860251)  # those of `voxel_grid`
CHUNK = 16  # samples that are found and evaluated together
# Where `values` holds what; the first 48, and the 16 from SLOPES on, are those of `gradients`.
BASIS, FACTORS, RAWS, SLOPES, LEFTS, DOTS, LOBES = 48, 64, 96, 112, 128, 160, 224
BIAS = FACTORS + 16
PULL = WIDTH  # a note that distortion writes, once the width is no longer needed


@inlined
def _place(grid: Any, first: Any, last: Any, rows: Any, corners: Any, weights: Any, notes: Any) -> None:
    """Compute the corners and weights of samples first ≤ s < last, and prefetch their rows."""
    for s in range(first, last):
        at = s * NOTES
        i, j, k = int(notes[at + CELL_X]), int(notes[at + CELL_Y]), int(notes[at + CELL_Z])
        d = i >> 12
        begin, ny, nz = grid.begins[np.uint64(d)], grid.sides[np.uint64(d), 0], grid.sides[np.uint64(d), 1]
        place(
            corners, weights, at, grid.table, grid.bricks, begin, ny, nz, i & 4095, j, k, notes[at + X], notes[at + Y],
            notes[at + Z],
        )  # fmt: skip
        prefetch(rows, corners, at)


@inlined
def _evaluate(first: Any, last: Any, step: Any, rows: Any, corners: Any, weights: Any, values: Any) -> None:
    """Compute colours and 1 − α of samples first ≤ s < last, at most CHUNK, as vectors.

    Writes to `values`, 4 a sample from DOTS on: red, green, blue, and softplus' of the raw density, all four sigmoids.
    From RAWS on, raw densities; from LEFTS on, 1 − α; from LOBES on, g · d, whose square is the gloss.
    """
    for s in range(last - first):
        # the raw density waits where 1 − α comes to stand
        gather_dots(values, DOTS + 4 * s, rows, corners, weights, (first + s) * 8, values, FACTORS, LEFTS + s)
    for s in range(CHUNK):
        raw, lobe = values[LEFTS + s] + values[BIAS], values[DOTS + 4 * s + 3]
        for c in range(3):
            values[DOTS + 4 * s + c] -= lobe * lobe
        values[LOBES + s] = lobe
        values[RAWS + s] = raw
        values[DOTS + 4 * s + 3] = -raw
        values[LEFTS + s] = exp(-step * (max(raw, F(0)) + log(F(1) + exp(-abs(raw)))))
    for q in range(4 * CHUNK):
        values[DOTS + q] = F(1) / (F(1) + exp(values[DOTS + q]))


@inlined
def sample(
    grid: Any, rays: Any, r: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any, gradient: Any,
    train: Any, pixel: Any,
) -> Any:  # fmt: skip
    """Find and composite the samples of ray r, until the transmittance is below STOP.

    Writes the samples' notes, and colour, opacity and Σ w t of pixel r. Returns how many samples it used. They are
    found chunk by chunk, because those behind a surface are not needed.
    """
    corners, weights, values, notes = scratch.corners, scratch.weights, scratch.values, scratch.notes
    _set_basis(rays.views, r, bias, values)
    transmittance = F(1)
    red, green, blue, far = F(0), F(0), F(0), F(0)
    way, t = enter(grid, rays, r, step)
    capacity = notes.shape[0] // NOTES
    n = 0
    while n < capacity and transmittance >= STOP:
        begin = n
        end, t = advance(grid, way, step, t, notes, begin, min(begin + CHUNK, capacity))
        _place(grid, begin, end, rows, corners, weights, notes)
        _evaluate(begin, end, step, rows, corners, weights, values)
        for s in range(end - begin):
            at = n * NOTES
            r1, g1, b1 = values[DOTS + 4 * s], values[DOTS + 4 * s + 1], values[DOTS + 4 * s + 2]
            left = values[LEFTS + s]
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
            notes[at + RAW] = values[RAWS + s]
            scratch.lobes[n] = values[LOBES + s]
            if train:
                prefetch(gradient, corners, at)
            transmittance *= left
            n += 1
            if transmittance < STOP:
                break
        if end < begin + CHUNK:
            break
    pixel[r, 0] = red + transmittance * background[0]
    pixel[r, 1] = green + transmittance * background[1]
    pixel[r, 2] = blue + transmittance * background[2]
    pixel[r, 3] = F(1) - transmittance
    pixel[r, 4] = far
    return n


@inlined
def _set_basis(views: Any, r: Any, bias: Any, values: Any) -> None:
    """Write the basis of ray r's direction, and the factors for `gather_dots`.

    Its first three dots are the sigmoids' negated, the fourth is g · d.
    """
    values[BASIS] = SH0
    values[BASIS + 1] = SH1 * views[r, 1]
    values[BASIS + 2] = SH1 * views[r, 2]
    values[BASIS + 3] = SH1 * views[r, 0]
    for c in range(12):
        values[FACTORS + c] = -values[BASIS + (c & 3)]
    values[FACTORS + 12] = F(0)
    for c in range(3):
        values[FACTORS + 13 + c] = views[r, c]
    values[BIAS] = bias


@jit
def render(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any,
) -> None:  # fmt: skip
    """Write pixel[r] = (colour, opacity, Σ w t) for first ≤ r < last."""
    for r in range(first, last):
        sample(grid, rays, r, step, bias, rows, background, scratch, rows, False, pixel)


@jit
def trace(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any, kept: Any, counts: Any,
) -> Any:  # fmt: skip
    """Render, and copy the notes of the samples to `kept` up to its capacity; returns how many samples there are."""
    total = 0
    for r in range(first, last):
        n = sample(grid, rays, r, step, bias, rows, background, scratch, rows, False, pixel)
        counts[r] = n
        for s in range(min(n, kept.shape[0] - total)):
            for q in range(NOTES):
                kept[total + s, q] = scratch.notes[s * NOTES + q]
        total += n
    return total


@jit
def place_in_ray(t: Any, unit: Any, folded: Any) -> Any:
    """s in units of `unit`; folded: t/(t + 1) of it, so that all of space has a finite length."""
    t = t / unit
    return t / (F(1) + t) if folded else t


@inlined
def _distort(notes: Any, n: Any, distortion: Any, reach: Any, unit: Any, folded: Any) -> None:
    """Write a_i = ∂(distortion)/∂w_i of a ray's n samples to their notes, from front to back.

    With weights and positions summed over the samples within reach in front of sample i (−) and behind it (+):
    a_i = λ (2 (s_i (W⁻ − W⁺) − (S⁻ − S⁺)) + ⅔ w_i Δs_i), W = Σ w, S = Σ w s.
    """
    w_front, s_front, w_behind, s_behind = F(0), F(0), F(0), F(0)
    begin, end = 0, 0  # in front are begin ≤ j < i, and behind i < j < end
    for i in range(n):
        place, w = _place_and_weight(notes, i, unit, folded)
        while end < n:
            other, weight = _place_and_weight(notes, end, unit, folded)
            if other - place >= reach:
                break
            w_behind += weight
            s_behind += weight * other
            end += 1
        while begin < i:
            other, weight = _place_and_weight(notes, begin, unit, folded)
            if place - other < reach:
                break
            w_front -= weight
            s_front -= weight * other
            begin += 1
        w_behind -= w
        s_behind -= w * place
        width = notes[i * NOTES + WIDTH] / unit
        if folded:
            width *= (F(1) - place) * (F(1) - place)
        pairs = F(2) * (place * (w_front - w_behind) - (s_front - s_behind))
        notes[i * NOTES + PULL] = distortion * (pairs + F(2 / 3) * w * width)
        w_front += w
        s_front += w * place


@inlined
def _place_and_weight(notes: Any, sample: Any, unit: Any, folded: Any) -> Any:
    at = sample * NOTES
    return place_in_ray(notes[at + DISTANCE], unit, folded), notes[at + TRANSMITTANCE] * notes[at + ALPHA]


@inlined
def note_rows(bits: Any, corners: Any, at: Any) -> None:
    """Set the bits of the 8 rows of a sample."""
    for c in range(8):
        row = np.uint64(corners[at + c] >> 4)
        bits[row >> np.uint64(6)] |= np.uint64(1) << (row & np.uint64(63))


@jit
def gradients(
    grid: Any, rays: Any, truth: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any,
    scratch: Any, pixel: Any, gradient: Any, touched: Any, smoothness: Any, smoothness_color: Any,
    slope: Any, turn: Any, distortion: Any, reach: Any, unit: Any, folded: Any,
) -> Any:  # fmt: skip
    """Add ∂(½ Σ squared error + smoothness + turn + distortion)/∂rows of rays first ≤ r < last to `gradient`.

    For the last three see `March`.
    Returns the sum of squared errors, and the number of samples.

    A loss with ∂L/∂w_i = a_i beside the colours acts like one more channel with the colours a_i and no background, so
    that it is added to what an error takes from the colours; for distortion see `_distort`.
    With S_i = Σ_{j>i} w_j c_j + T_end · background, ∂C/∂σ_i = δ_i (T_{i+1} c_i − S_i): NeRF Eq. 3, differentiated.
    """
    basis = scratch.values[BASIS : BASIS + 4]
    corners, weights, values, notes = scratch.corners, scratch.weights, scratch.values, scratch.notes
    for q in range(16):
        values[32 + q] = smoothness_color if q < 12 else smoothness if q == 12 else F(0)
        values[SLOPES + q] = (slope - F(1)) * values[32 + q]  # b + slope · l = (b + l) + (slope − 1) · l
    error = 0.0
    samples = 0
    behind_rise = F(0), F(0), F(0)  # of the sample behind
    for r in range(first, last):
        n = sample(grid, rays, r, step, bias, rows, background, scratch, gradient, True, pixel)
        samples += n
        er, eg, eb = pixel[r, 0] - truth[r, 0], pixel[r, 1] - truth[r, 1], pixel[r, 2] - truth[r, 2]
        error += er * er + eg * eg + eb * eb
        behind = (F(1) - pixel[r, 3]) * (background[0] * er + background[1] * eg + background[2] * eb)
        if distortion > 0:
            _distort(notes, n, distortion, reach, unit, folded)
        for q in range(n):
            at = (n - 1 - q) * 8
            r1, g1, b1 = notes[at + RED], notes[at + GREEN], notes[at + BLUE]
            transmittance, alpha = notes[at + TRANSMITTANCE], notes[at + ALPHA]
            w, along = transmittance * alpha, r1 * er + g1 * eg + b1 * eb
            if distortion > 0:
                along += notes[at + PULL]
            by_sigma = step * (transmittance * (F(1) - alpha) * along - behind)
            behind += w * along
            gr, gg, gb = w * er * r1 * (F(1) - r1), w * eg * g1 * (F(1) - g1), w * eb * b1 * (F(1) - b1)
            for c in range(4):
                values[16 + c] = gr * basis[c]
                values[20 + c] = gg * basis[c]
                values[24 + c] = gb * basis[c]
            by_lobe = F(2) * scratch.lobes[n - 1 - q] * (gr + gg + gb)
            for c in range(3):
                values[29 + c] = by_lobe * rays.views[r, c]
            values[28] = by_sigma / (F(1) + exp(-notes[at + RAW]))  # softplus' is the sigmoid
            if smoothness > 0 or smoothness_color > 0:
                scatter_smooth(gradient, corners, weights, at, values, 16, rows, 32, SLOPES)
            else:
                scatter(gradient, corners, weights, at, values, 16)
            if turn > 0 and r % TURN_RAYS == 0:
                front = rise(rows, corners, at)
                if q > 0 and touch(corners, at):
                    add_turn(gradient, corners, at, turn, front, behind_rise)
                behind_rise = front
            note_rows(touched, corners, at)
    return error, samples


@inlined
def _hardening(rate: Any, square: Any, raw: Any) -> Any:
    """How much the raw density `raw`, with the bias, rises; see `Adam`."""
    if rate > 0:
        opacity = F(1) / (F(1) + math.exp(-raw))  # 1 − e^−softplus(x) is the sigmoid
        left = min(F(1), (F(1) - opacity) / OPAQUE)
        return rate * (opacity - CLEAR) * left * CALM / (CALM + square)
    return F(0)


@jit
def adam(
    first: Any, last: Any, rows: Any, moments: Any, ema: Any, gradient: Any, touched: Any, rate_color: Any,
    rate_view: Any, rate_gloss: Any, rate_density: Any, beta2: Any, correction2: Any, epsilon: Any, least_square: Any,
    ema_rate: Any, harden: Any, bias: Any,
) -> None:  # fmt: skip
    """One step of Adam without first moments on the touched rows 64 first ≤ r < 64 last, and of the rows' EMA.

    Gradients, one array a shard, are summed and cleared. A row has three second moments: the colour coefficients share
    one, density has one, and the components of gloss share one.
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
            p, g = rows[at : at + 16], gradient[0, at : at + 16]
            for s in range(1, shards):
                other = gradient[s, at : at + 16]
                for c in range(16):
                    g[c] += other[c]
                    other[c] = 0
            color, density, gloss = F(0), g[12] * g[12], F(1 / 3) * (g[13] * g[13] + g[14] * g[14] + g[15] * g[15])
            for c in range(12):
                color += g[c] * g[c]
            color *= F(1 / 12)
            square = moments[3 * (b * 64 + q) : 3 * (b * 64 + q) + 3]
            square[0] = beta2 * square[0] + (F(1) - beta2) * color
            square[1] = beta2 * square[1] + (F(1) - beta2) * density
            square[2] = beta2 * square[2] + (F(1) - beta2) * gloss
            whole = F(1) / (math.sqrt(max(square[0] * correction2, least_square * color)) + epsilon)
            for c in range(12):
                p[c] -= (rate_view if c & 3 else rate_color) * whole * g[c]  # the first of four is of degree 0
            p[12] -= rate_density / (math.sqrt(max(square[1] * correction2, least_square * density)) + epsilon) * g[12]
            p[12] += _hardening(harden * rate_density, square[1] * correction2, p[12] + bias)
            by_gloss = rate_gloss / (math.sqrt(max(square[2] * correction2, least_square * gloss)) + epsilon)
            for c in range(13, 16):
                p[c] -= by_gloss * g[c]
            a = ema[at : at + 16]
            for c in range(16):
                a[c] += ema_rate * (p[c] - a[c])
            for c in range(16):
                g[c] = 0
