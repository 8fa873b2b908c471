"""The voxel grid's hot loops for a CPU: march, interpolate, composite and their backward pass in one function.

What they compute is written down plainly in `nerf_core.kernels.torch_voxels`; `grid` is `VoxelGrid.arrays()`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.kernels.numba_vectors import exp, gather, jit, prefetch, scatter, smooth

F = np.float32
STOP = F(1e-3)  # transmittance at which nothing behind can still change an 8-bit pixel by one step
NEVER = F(1e30)
STRAIGHT = F(0.25)  # of its distance from the centre: so far a contracted ray counts as straight when it leaps
# What a ray keeps of each sample between its passes, in one row of `notes`: α, T, colour, raw σ, t, Δt.
ALPHA, LIGHT, RED, GREEN, BLUE, RAW, DISTANCE, WIDTH, NOTES = 0, 1, 2, 3, 4, 5, 6, 7, 8
SH0, SH1 = F(0.28209479), F(0.48860251)  # 1/√4π, √(3/4π)


@jit
def _gap(x: Any, v: Any, low: Any, high: Any) -> Any:
    """After how much t a point at x with velocity v leaves [low, high]; never, where it moves along it."""
    return NEVER if v == 0 else max((low - x) / v, (high - x) / v)


@jit
def _clipped(x: Any, v: Any, side: Any, first: Any, last: Any) -> Any:
    """[first, last] of t cut to where x + t v lies in [0, side]; empty where it never does."""
    if v == 0:
        return (first, last) if 0 <= x <= side else (first, F(-1))
    a, b = -x / v, (side - x) / v
    return max(first, min(a, b)), min(last, max(a, b))


@jit
def _bent(wx: Any, wy: Any, wz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Under contraction x → f x with f = (2 − s) s, s = 1/‖x‖∞, its velocity is f d + f′ x: returns f, f′ and ‖x‖∞."""
    ax, ay, az = abs(wx), abs(wy), abs(wz)
    norm = max(ax, ay, az)
    if norm <= 1:
        return F(1), F(0), norm
    if ax == norm:
        slope = dx if wx > 0 else -dx
    elif ay == norm:
        slope = dy if wy > 0 else -dy
    else:
        slope = dz if wz > 0 else -dz
    s = F(1) / norm
    return (F(2) - s) * s, (F(2) * s - F(2)) * s * s * slope, norm


@jit
def _corners(i: Any, j: Any, k: Any, ny: Any, nz: Any, table: Any, corners: Any, at: Any) -> None:
    """Offsets of the 8 vertices' rows of cell (i, j, k), z fastest; ny, nz: bricks a side."""
    li, lj, lk = i & 3, j & 3, k & 3
    if li < 3 and lj < 3 and lk < 3:  # all in one brick
        base = np.int64(table[np.uint64(((i >> 2) * ny + (j >> 2)) * nz + (k >> 2))])
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
        base = np.int64(table[np.uint64(((a >> 2) * ny + (b >> 2)) * nz + (d >> 2))])
        corners[at + c] = (base * 64 + ((a & 3) << 4) + ((b & 3) << 2) + (d & 3)) << 4


@jit
def _weigh(fx: Any, fy: Any, fz: Any, weights: Any, at: Any) -> None:
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
def _march(grid: Any, rays: Any, r: Any, step: Any, rows: Any, corners: Any, weights: Any, notes: Any) -> Any:  # noqa: PLR0915  one loop, with everything that it needs in registers
    """Samples of ray r in occupied cells, front to back: their corners, weights, t and Δt; returns how many."""
    nx, ny, nz = grid.size[0], grid.size[1], grid.size[2]
    bricks_y, bricks_z = (ny >> 2) + 1, (nz >> 2) + 1
    blocks_y, blocks_z = (ny + 3) >> 2, (nz + 3) >> 2
    sx, sy, sz = grid.scale[0], grid.scale[1], grid.scale[2]
    bx, by, bz = grid.origin[0], grid.origin[1], grid.origin[2]
    ox, oy, oz = rays.origins[r, 0], rays.origins[r, 1], rays.origins[r, 2]
    dx, dy, dz = rays.directions[r, 0], rays.directions[r, 1], rays.directions[r, 2]
    # position and velocity in cells, where space is not contracted
    gx, gy, gz = (ox - bx) * sx, (oy - by) * sy, (oz - bz) * sz
    vx, vy, vz = dx * sx, dy * sy, dz * sz
    ux, uy, uz = vx, vy, vz
    t, last, norm = rays.near[r], rays.far[r], F(0)
    if not grid.contracted:
        t, last = _clipped(gx, vx, nx, t, last)
        t, last = _clipped(gy, vy, ny, t, last)
        t, last = _clipped(gz, vz, nz, t, last)
    straight = step / math.sqrt(vx * vx + vy * vy + vz * vz)
    dt = straight
    t += rays.offsets[r] * dt
    capacity = notes.shape[0] // NOTES
    n = 0
    while t < last and n < capacity:
        px, py, pz = gx + t * vx, gy + t * vy, gz + t * vz
        if grid.contracted:
            wx, wy, wz = ox + t * dx, oy + t * dy, oz + t * dz
            f, slope, norm = _bent(wx, wy, wz, dx, dy, dz)
            ux, uy, uz, dt = vx, vy, vz, straight
            if norm > 1:
                px, py, pz = (wx * f - bx) * sx, (wy * f - by) * sy, (wz * f - bz) * sz
                ux, uy, uz = (dx * f + wx * slope) * sx, (dy * f + wy * slope) * sy, (dz * f + wz * slope) * sz
                dt = step / math.sqrt(ux * ux + uy * uy + uz * uz)
        i, j, k = int(px), int(py), int(pz)
        if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:  # by rounding, on the border
            t += dt
            continue
        leap = grid.leap[np.uint64(((i >> 2) * blocks_y + (j >> 2)) * blocks_z + (k >> 2))]
        if leap > 0:  # nothing within leap − 1 blocks of this one: to the far side of that cube
            reach = 4 * (leap - 1)
            x, y, z, side = (i & ~3) - reach, (j & ~3) - reach, (k & ~3) - reach, 4 + 2 * reach
            gap = min(_gap(px, ux, x, x + side), _gap(py, uy, y, y + side), _gap(pz, uz, z, z + side))
            if norm > 1:
                gap = min(gap, STRAIGHT * norm)
            t += max(math.floor(gap / dt) + F(1), F(1)) * dt
        elif grid.occupied[np.uint64((i * ny + j) * nz + k)] == 0:
            t += dt
        else:
            at = n * 8
            _corners(i, j, k, bricks_y, bricks_z, grid.table, corners, at)
            prefetch(rows, corners, at)
            _weigh(px - F(i), py - F(j), pz - F(k), weights, at)
            notes[at + DISTANCE] = t
            notes[at + WIDTH] = dt
            n += 1
            t += dt
    return n


@jit
def _composite(
    n: Any, basis: Any, step: Any, bias: Any, rows: Any, corners: Any, weights: Any, values: Any, notes: Any,
    gradient: Any, train: Any, pixel: Any, r: Any, background: Any,
) -> Any:  # fmt: skip
    """Evaluate n samples until the light is gone; writes colour, opacity, Σwt of pixel r; returns how many counted."""
    light = F(1)
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
        w = light * (F(1) - left)
        red += w * r1
        green += w * g1
        blue += w * b1
        far += w * notes[at + DISTANCE]
        notes[at + ALPHA] = F(1) - left
        notes[at + LIGHT] = light
        notes[at + RED] = r1
        notes[at + GREEN] = g1
        notes[at + BLUE] = b1
        notes[at + RAW] = raw
        if train:
            prefetch(gradient, corners, at)
        light *= left
        if light < STOP:
            used = s + 1
            break
    pixel[r, 0] = red + light * background[0]
    pixel[r, 1] = green + light * background[1]
    pixel[r, 2] = blue + light * background[2]
    pixel[r, 3] = F(1) - light
    pixel[r, 4] = far
    return used


@jit
def _basis(views: Any, r: Any, basis: Any) -> None:
    basis[0] = SH0
    basis[1] = SH1 * views[r, 1]
    basis[2] = SH1 * views[r, 2]
    basis[3] = SH1 * views[r, 0]


@jit
def render(
    grid: Any, rays: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any,
    pixel: Any,
) -> None:  # fmt: skip
    """pixel[r] = (colour, opacity, Σwt) for first ≤ r < last."""
    basis = scratch.values[48:52]
    for r in range(first, last):
        n = _march(grid, rays, r, step, rows, scratch.corners, scratch.weights, scratch.notes)
        _basis(rays.views, r, basis)
        _composite(
            n, basis, step, bias, rows, scratch.corners, scratch.weights, scratch.values, scratch.notes, rows, False,
            pixel, r, background,
        )  # fmt: skip


@jit
def trace(
    grid: Any, rays: Any, r: Any, step: Any, bias: Any, rows: Any, background: Any, scratch: Any, pixel: Any
) -> Any:
    """`render` of ray r alone; its samples stay in scratch.notes. Returns how many."""
    basis = scratch.values[48:52]
    n = _march(grid, rays, r, step, rows, scratch.corners, scratch.weights, scratch.notes)
    _basis(rays.views, r, basis)
    return _composite(
        n, basis, step, bias, rows, scratch.corners, scratch.weights, scratch.values, scratch.notes, rows, False,
        pixel, r, background,
    )  # fmt: skip


@jit
def gradients(
    grid: Any, rays: Any, truth: Any, first: Any, last: Any, step: Any, bias: Any, rows: Any, background: Any,
    scratch: Any, pixel: Any, gradient: Any, touched: Any, visible: Any, threshold: Any, smoothness: Any,
) -> Any:  # fmt: skip
    """Add ∂(½ Σ squared error)/∂rows of rays first ≤ r < last to `gradient`; returns the squared error and samples.

    With S_i = Σ_{j>i} w_j c_j + T_end · background, ∂C/∂σ_i = δ_i (T_{i+1} c_i − S_i): NeRF Eq. 3, differentiated.
    """
    basis = scratch.values[48:52]
    corners, weights, values, notes = scratch.corners, scratch.weights, scratch.values, scratch.notes
    for q in range(16):
        values[32 + q] = smoothness if q == 12 else F(0)
    error = 0.0
    samples = 0
    for r in range(first, last):
        n = _march(grid, rays, r, step, rows, corners, weights, notes)
        _basis(rays.views, r, basis)
        n = _composite(
            n, basis, step, bias, rows, corners, weights, values, notes, gradient, True, pixel, r, background
        )
        samples += n
        er, eg, eb = pixel[r, 0] - truth[r, 0], pixel[r, 1] - truth[r, 1], pixel[r, 2] - truth[r, 2]
        error += er * er + eg * eg + eb * eb
        behind = (F(1) - pixel[r, 3]) * (background[0] * er + background[1] * eg + background[2] * eb)
        for q in range(n):
            at = (n - 1 - q) * 8
            r1, g1, b1 = notes[at + RED], notes[at + GREEN], notes[at + BLUE]
            light, alpha = notes[at + LIGHT], notes[at + ALPHA]
            w, along = light * alpha, r1 * er + g1 * eg + b1 * eb
            if w > threshold:  # told at the cell's lowest vertex
                row = np.uint64(corners[at] >> 4)
                visible[row >> np.uint64(6)] |= np.uint64(1) << (row & np.uint64(63))
            by_sigma = step * (light * (F(1) - alpha) * along - behind)
            behind += w * along
            gr, gg, gb = w * er * r1 * (F(1) - r1), w * eg * g1 * (F(1) - g1), w * eb * b1 * (F(1) - b1)
            for c in range(4):
                values[16 + c] = gr * basis[c]
                values[20 + c] = gg * basis[c]
                values[24 + c] = gb * basis[c]
            values[28] = by_sigma / (F(1) + exp(-notes[at + RAW]))  # softplus' is the sigmoid
            scatter(gradient, corners, weights, at, values, 16)
            if smoothness > 0:
                smooth(gradient, rows, corners, at, values, 32)
            for c in range(8):
                row = np.uint64(corners[at + c] >> 4)
                touched[row >> np.uint64(6)] |= np.uint64(1) << (row & np.uint64(63))
    return error, samples


@jit
def adam(
    first: Any, last: Any, rows: Any, moments: Any, gradient: Any, touched: Any, rate_color: Any, rate_density: Any,
    keep: Any, keep_square: Any, warm: Any, warm_square: Any, epsilon: Any,
) -> None:  # fmt: skip
    """Adam on the touched rows of bricks first ≤ b < last; gradients, one array a shard, are added up and cleared.

    A row shares one second moment among its colour coefficients; it lies, with density's, in the moments' padding:
    half the memory, and half the traffic, of a moment for each.
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
            v_color = keep_square * m[14] + (F(1) - keep_square) * square * F(1 / 12)
            v_density = keep_square * m[15] + (F(1) - keep_square) * g[12] * g[12]
            by_color = rate_color * warm / (math.sqrt(v_color * warm_square) + epsilon)
            by_density = rate_density * warm / (math.sqrt(v_density * warm_square) + epsilon)
            for c in range(13):
                m[c] = keep * m[c] + (F(1) - keep) * g[c]
            for c in range(12):
                p[c] -= by_color * m[c]
            p[12] -= by_density * m[12]
            m[14], m[15] = v_color, v_density
            for c in range(16):
                g[c] = 0
