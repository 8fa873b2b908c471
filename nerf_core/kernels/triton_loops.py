"""The hash grid's and packed samples' hot loops for CUDA; `nerf_core.kernels.torch_packed` says the same plainly.

A program works on BLOCK rays or points at once. Gradients of the table are added atomically: their order, and so the
last bits of the weights, differ from run to run.
"""

# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def corner(i, j, k, fx, fy, fz, n, rows, c: tl.constexpr):
    """Row of the table and trilinear weight of corner c, z fastest, of cell (i, j, k) on a level of n cells a side."""
    a: tl.constexpr = (c >> 2) & 1
    b: tl.constexpr = (c >> 1) & 1
    d: tl.constexpr = c & 1
    side = (n + 1).to(tl.int64)
    x, y, z = i + a, j + b, k + d
    straight = (x.to(tl.int64) * side + y) * side + z
    hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * 2654435761) ^ (z.to(tl.uint32) * 805459861)
    row = tl.where(side * side * side <= rows, straight, (hashed & (rows - 1).to(tl.uint32)).to(tl.int64))
    wx = fx if a else 1 - fx
    wy = fy if b else 1 - fy
    wz = fz if d else 1 - fz
    return row, wx * wy * wz


@triton.jit
def place(x, m, n, real):
    """Cell and position within it of points m on a level of n cells a side."""
    px = tl.load(x + m * 3, mask=real, other=0.0) * n
    py = tl.load(x + m * 3 + 1, mask=real, other=0.0) * n
    pz = tl.load(x + m * 3 + 2, mask=real, other=0.0) * n
    i = tl.minimum(px.to(tl.int32), n - 1)
    j = tl.minimum(py.to(tl.int32), n - 1)
    k = tl.minimum(pz.to(tl.int32), n - 1)
    return i, j, k, px - i, py - j, pz - k


@triton.jit
def encode(x, table, resolutions, features, count, rows, levels, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    level = tl.program_id(1)
    real = m < count
    n = tl.load(resolutions + level).to(tl.int32)
    i, j, k, fx, fy, fz = place(x, m, n, real)
    f = tl.arange(0, WIDTH)
    total = tl.zeros((BLOCK, WIDTH), dtype=tl.float32)
    for c in tl.static_range(8):
        row, w = corner(i, j, k, fx, fy, fz, n, rows, c)
        at = table + (level.to(tl.int64) * rows + row)[:, None] * WIDTH + f[None, :]
        total += w[:, None] * tl.load(at, mask=real[:, None], other=0.0)
    out = features + m[:, None].to(tl.int64) * (levels * WIDTH) + level * WIDTH + f[None, :]
    tl.store(out, total, mask=real[:, None])


@triton.jit
def encode_gradient(x, gradient, resolutions, into, count, rows, levels, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    level = tl.program_id(1)
    real = m < count
    n = tl.load(resolutions + level).to(tl.int32)
    i, j, k, fx, fy, fz = place(x, m, n, real)
    f = tl.arange(0, WIDTH)
    given = gradient + m[:, None].to(tl.int64) * (levels * WIDTH) + level * WIDTH + f[None, :]
    g = tl.load(given, mask=real[:, None], other=0.0)
    for c in tl.static_range(8):
        row, w = corner(i, j, k, fx, fy, fz, n, rows, c)
        at = into + (level.to(tl.int64) * rows + row)[:, None] * WIDTH + f[None, :]
        tl.atomic_add(at, w[:, None] * g, mask=real[:, None])


@triton.jit
def composite(tau, rgb, t, ends, background, pixel, count, BLOCK: tl.constexpr):
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = r < count
    first = tl.load(ends + r, mask=real, other=0)
    last = tl.load(ends + r + 1, mask=real, other=0)
    light = tl.full((BLOCK,), 1.0, tl.float32)
    red = tl.zeros((BLOCK,), tl.float32)
    green = tl.zeros((BLOCK,), tl.float32)
    blue = tl.zeros((BLOCK,), tl.float32)
    far = tl.zeros((BLOCK,), tl.float32)
    for s in range(tl.max(last - first)):
        at = first + s
        some = real & (at < last)
        left = tl.exp(-tl.load(tau + at, mask=some, other=0.0))
        w = light * (1 - left)
        red += w * tl.load(rgb + at * 3, mask=some, other=0.0)
        green += w * tl.load(rgb + at * 3 + 1, mask=some, other=0.0)
        blue += w * tl.load(rgb + at * 3 + 2, mask=some, other=0.0)
        far += w * tl.load(t + at, mask=some, other=0.0)
        light *= left
    out = pixel + r * 5
    tl.store(out, red + light * tl.load(background), mask=real)
    tl.store(out + 1, green + light * tl.load(background + 1), mask=real)
    tl.store(out + 2, blue + light * tl.load(background + 2), mask=real)
    tl.store(out + 3, 1 - light, mask=real)
    tl.store(out + 4, far, mask=real)


@triton.jit
def composite_gradient(gradient, tau, rgb, ends, background, by_tau, by_rgb, count, BLOCK: tl.constexpr):
    """∂C/∂τ_i = T_{i+1} c_i − S_i with S_i = Σ_{j>i} w_j c_j + T_end · background.

    Going back from the end, T_i = T_{i+1} / (1 − α_i) would divide by nothing behind an opaque sample: T is found on a
    first way along the ray, and kept in by_tau until the way back.
    """
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = r < count
    first = tl.load(ends + r, mask=real, other=0)
    last = tl.load(ends + r + 1, mask=real, other=0)
    gr = tl.load(gradient + r * 3, mask=real, other=0.0)
    gg = tl.load(gradient + r * 3 + 1, mask=real, other=0.0)
    gb = tl.load(gradient + r * 3 + 2, mask=real, other=0.0)
    most = tl.max(last - first)
    light = tl.full((BLOCK,), 1.0, tl.float32)
    for s in range(most):
        at = first + s
        some = real & (at < last)
        left = tl.exp(-tl.load(tau + at, mask=some, other=0.0))
        w = light * (1 - left)
        light *= left
        tl.store(by_tau + at, light, mask=some)
        tl.store(by_rgb + at * 3, w * gr, mask=some)
        tl.store(by_rgb + at * 3 + 1, w * gg, mask=some)
        tl.store(by_rgb + at * 3 + 2, w * gb, mask=some)
    shown = tl.load(background) * gr + tl.load(background + 1) * gg + tl.load(background + 2) * gb
    behind = light * shown
    for s in range(most):
        at = last - 1 - s
        some = real & (at >= first)
        red = tl.load(rgb + at * 3, mask=some, other=0.0)
        green = tl.load(rgb + at * 3 + 1, mask=some, other=0.0)
        blue = tl.load(rgb + at * 3 + 2, mask=some, other=0.0)
        along = red * gr + green * gg + blue * gb
        after = tl.load(by_tau + at, mask=some, other=0.0)
        tl.store(by_tau + at, after * along - behind, mask=some)
        by_red = tl.load(by_rgb + at * 3, mask=some, other=0.0)
        by_green = tl.load(by_rgb + at * 3 + 1, mask=some, other=0.0)
        by_blue = tl.load(by_rgb + at * 3 + 2, mask=some, other=0.0)
        behind += tl.where(some, by_red * red + by_green * green + by_blue * blue, 0.0)


@triton.jit
def adam(
    table, gradient, mean, square, count, rate, warm, warm_square, epsilon, BETA1: tl.constexpr, BETA2: tl.constexpr,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """On rows that have a gradient, which is cleared."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    at = row[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :]
    real = (row < count)[:, None]
    g = tl.load(gradient + at, mask=real, other=0.0)
    some = real & (tl.max(tl.abs(g), axis=1) > 0)[:, None]
    m = BETA1 * tl.load(mean + at, mask=some, other=0.0) + (1 - BETA1) * g
    v = BETA2 * tl.load(square + at, mask=some, other=0.0) + (1 - BETA2) * g * g
    p = tl.load(table + at, mask=some, other=0.0)
    tl.store(table + at, p - rate * (m * warm) / (tl.sqrt(v * warm_square) + epsilon), mask=some)
    tl.store(mean + at, m, mask=some)
    tl.store(square + at, v, mask=some)
    tl.store(gradient + at, tl.zeros_like(g), mask=some)
