"""The hot loops of packed samples and the hash grid for CUDA. The plain reference is `nerf_core.kernels.torch_packed`.

A program works on BLOCK rays or points at once. Gradients of the table are added atomically. Their order differs from
run to run, and so do the last bits of the weights.
"""

# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

import triton
import triton.language as tl

# Triton compiles a kernel anew where a number is 1 or divisible by 16 and was not before, and where an address has
# another alignment. From picture to picture and from ray to ray that is so, and a window would wait for each of them.
kernel = triton.jit(
    do_not_specialize=("rays", "capacity", "count"),
    do_not_specialize_on_alignment=("origins", "directions", "near", "far", "offsets"),
)

# In products they stand behind the tensor: Triton 3.8 interprets a constant times a tensor as a constant.
STRAIGHT = tl.constexpr(0.1)  # as `nerf_core.kernels.torch_march.STRAIGHT`
NEARING = tl.constexpr(0.25)  # as there
STEPPED = tl.constexpr(2**-22)  # as there


@triton.jit
def clipped(x, v, side, first, last):
    """The part of [first, last] in which x + t v lies in [0, side]; empty if there is none."""
    still = v == 0
    safe = tl.where(still, 1.0, v)
    a, b = -x / safe, (side - x) / safe
    beside = still & ((x < 0) | (x > side))
    first = tl.where(still, first, tl.maximum(first, tl.minimum(a, b)))
    last = tl.where(still, last, tl.minimum(last, tl.maximum(a, b)))
    return first, tl.where(beside, first - 1, last)


@triton.jit
def gap_of(x, v, low, side):
    """The t until a point at x with velocity v leaves [low, low + side]; 1e30 for v = 0."""
    still = v == 0
    safe = tl.where(still, 1.0, v)
    return tl.where(still, 1e30, tl.maximum((low - x) / safe, (low + side - x) / safe))


@kernel
def march(  # noqa: PLR0915  one loop, with all that it needs in registers
    origins, directions, near, far, offsets, occupied, leap, row_offsets, counts, x, t_out, width, rays, capacity, step,
    bx, by, bz, sx, sy, sz, nx, ny, nz, CONTRACTED: tl.constexpr, WRITE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count each ray's samples in occupied cells; or, with WRITE, write them from the ray's row offset on.

    The algorithm is that of `nerf_core.kernels.torch_march`. b, s, n: the box's corner, cells a unit, cells a side.
    """
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = r < rays
    ox = tl.load(origins + r * 3, mask=real, other=0.0)
    oy = tl.load(origins + r * 3 + 1, mask=real, other=0.0)
    oz = tl.load(origins + r * 3 + 2, mask=real, other=0.0)
    dx = tl.load(directions + r * 3, mask=real, other=1.0)
    dy = tl.load(directions + r * 3 + 1, mask=real, other=1.0)
    dz = tl.load(directions + r * 3 + 2, mask=real, other=1.0)
    gx, gy, gz = (ox - bx) * sx, (oy - by) * sy, (oz - bz) * sz
    vx, vy, vz = dx * sx, dy * sy, dz * sz
    t = tl.load(near + r, mask=real, other=0.0)
    last = tl.load(far + r, mask=real, other=-1.0)
    straight = step / tl.sqrt(vx * vx + vy * vy + vz * vz)
    real = real & (straight > 0) & (0 * (ox + oy + oz + t + last) == 0)  # NaN or infinity: no samples
    if not CONTRACTED:
        t, last = clipped(gx, vx, nx, t, last)
        t, last = clipped(gy, vy, ny, t, last)
        t, last = clipped(gz, vz, nz, t, last)
    length = tl.sqrt(dx * dx + dy * dy + dz * dz)
    t += tl.load(offsets + r, mask=real, other=0.0) * straight
    first = tl.load(row_offsets + r, mask=real, other=0)
    n = tl.zeros((BLOCK,), tl.int64)
    blocks_y, blocks_z = (ny + 3) // 4, (nz + 3) // 4
    alive = real & (t < last)
    while tl.max(alive.to(tl.int32), 0) > 0:
        px, py, pz = gx + t * vx, gy + t * vy, gz + t * vz
        ux, uy, uz = vx, vy, vz
        dt = straight
        farthest = tl.full((BLOCK,), 1e30, tl.float32)
        if CONTRACTED:
            wx, wy, wz = ox + t * dx, oy + t * dy, oz + t * dz
            norm = tl.maximum(tl.maximum(tl.abs(wx), tl.abs(wy)), tl.abs(wz))
            along_z = tl.where(wz > 0, dz, -dz)
            along_y = tl.where(tl.abs(wy) == norm, tl.where(wy > 0, dy, -dy), along_z)
            along = tl.where(tl.abs(wx) == norm, tl.where(wx > 0, dx, -dx), along_y)
            s = 1 / tl.maximum(norm, 1.0)
            f, slope = (2 - s) * s, (2 * s - 2) * s * s * along
            bent = norm > 1
            px = tl.where(bent, (wx * f - bx) * sx, px)
            py = tl.where(bent, (wy * f - by) * sy, py)
            pz = tl.where(bent, (wz * f - bz) * sz, pz)
            ux = tl.where(bent, (dx * f + wx * slope) * sx, vx)
            uy = tl.where(bent, (dy * f + wy * slope) * sy, vy)
            uz = tl.where(bent, (dz * f + wz * slope) * sz, vz)
            speed = tl.sqrt(ux * ux + uy * uy + uz * uz)  # may round to 0 far outside; the march then ends
            away = norm / length  # from the centre, in t
            curved = step / tl.maximum(speed, 1e-30)
            curved = tl.where(slope > 0, tl.minimum(curved, away * NEARING), curved)
            dt = tl.where(bent, curved, straight)
            farthest = tl.where(bent, away * STRAIGHT, farthest)
        dt = tl.maximum(dt, t * STEPPED)
        inside = alive & (px >= 0) & (py >= 0) & (pz >= 0) & (px < nx) & (py < ny) & (pz < nz)
        px, py, pz = tl.where(inside, px, 0.0), tl.where(inside, py, 0.0), tl.where(inside, pz, 0.0)
        i, j, k = px.to(tl.int32), py.to(tl.int32), pz.to(tl.int32)
        block = ((i >> 2) * blocks_y + (j >> 2)) * blocks_z + (k >> 2)
        hop = tl.load(leap + block, mask=inside, other=0).to(tl.int32)
        reach = 4 * (hop - 1)
        side = (4 + 2 * reach).to(tl.float32)
        gap = gap_of(px, ux, (((i >> 2) << 2) - reach).to(tl.float32), side)
        gap = tl.minimum(gap, gap_of(py, uy, (((j >> 2) << 2) - reach).to(tl.float32), side))
        gap = tl.minimum(gap, gap_of(pz, uz, (((k >> 2) << 2) - reach).to(tl.float32), side))
        gap = tl.minimum(gap, farthest)
        steps = tl.where(hop > 0, tl.maximum(tl.floor(gap / dt) + 1, 1.0), 1.0)
        filled = tl.load(occupied + (i * ny + j) * nz + k, mask=inside & (hop == 0), other=0) != 0
        if WRITE:
            at = first + n
            some = filled & (at < capacity)
            tl.store(x + at * 3, px / nx, mask=some)
            tl.store(x + at * 3 + 1, py / ny, mask=some)
            tl.store(x + at * 3 + 2, pz / nz, mask=some)
            tl.store(t_out + at, t, mask=some)
            tl.store(width + at, dt, mask=some)
        n += filled.to(tl.int64)
        t = tl.where(alive, t + steps * dt, t)
        alive = real & (t < last)
    if not WRITE:
        tl.store(counts + r, n, mask=r < rays)


@triton.jit
def corner(i, j, k, fx, fy, fz, n, rows, c: tl.constexpr):
    """The table's row, and the trilinear weight, of corner c of cell (i, j, k), z fastest. n: cells a side."""
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
    """The cells of points m, and the positions in them, on a level of n cells a side."""
    px = tl.load(x + m * 3, mask=real, other=0.0) * n
    py = tl.load(x + m * 3 + 1, mask=real, other=0.0) * n
    pz = tl.load(x + m * 3 + 2, mask=real, other=0.0) * n
    i = tl.minimum(px.to(tl.int32), n - 1)
    j = tl.minimum(py.to(tl.int32), n - 1)
    k = tl.minimum(pz.to(tl.int32), n - 1)
    return i, j, k, px - i, py - j, pz - k


@kernel
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


@kernel
def encode_gradient(x, gradient, resolutions, into, count, rows, levels, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    level = tl.program_id(1)
    real = m < count
    n = tl.load(resolutions + level).to(tl.int32)
    i, j, k, fx, fy, fz = place(x, m, n, real)
    f = tl.arange(0, WIDTH)
    given = gradient + m[:, None].to(tl.int64) * (levels * WIDTH) + level * WIDTH + f[None, :]
    g = tl.load(given, mask=real[:, None], other=0.0)
    some = (tl.max(tl.abs(g), axis=1) > 0)[:, None]  # no atomic additions of zeros
    for c in tl.static_range(8):
        row, w = corner(i, j, k, fx, fy, fz, n, rows, c)
        at = into + (level.to(tl.int64) * rows + row)[:, None] * WIDTH + f[None, :]
        tl.atomic_add(at, w[:, None] * g, mask=some)


@kernel
def composite(tau, rgb, t, row_offsets, background, pixel, count, BLOCK: tl.constexpr):
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = r < count
    first = tl.load(row_offsets + r, mask=real, other=0)
    last = tl.load(row_offsets + r + 1, mask=real, other=0)
    transmittance = tl.full((BLOCK,), 1.0, tl.float32)
    red = tl.zeros((BLOCK,), tl.float32)
    green = tl.zeros((BLOCK,), tl.float32)
    blue = tl.zeros((BLOCK,), tl.float32)
    far = tl.zeros((BLOCK,), tl.float32)
    for s in range(tl.max(last - first)):
        at = first + s
        some = real & (at < last)
        left = tl.exp(-tl.load(tau + at, mask=some, other=0.0))
        w = transmittance * (1 - left)
        red += w * tl.load(rgb + at * 3, mask=some, other=0.0)
        green += w * tl.load(rgb + at * 3 + 1, mask=some, other=0.0)
        blue += w * tl.load(rgb + at * 3 + 2, mask=some, other=0.0)
        far += w * tl.load(t + at, mask=some, other=0.0)
        transmittance *= left
    out = pixel + r * 5
    tl.store(out, red + transmittance * tl.load(background), mask=real)
    tl.store(out + 1, green + transmittance * tl.load(background + 1), mask=real)
    tl.store(out + 2, blue + transmittance * tl.load(background + 2), mask=real)
    tl.store(out + 3, 1 - transmittance, mask=real)
    tl.store(out + 4, far, mask=real)


@kernel
def composite_gradient(gradient, tau, rgb, row_offsets, background, by_tau, by_rgb, count, BLOCK: tl.constexpr):
    """∂C/∂τ_i = T_{i+1} c_i − S_i with S_i = Σ_{j>i} w_j c_j + T_end · background.

    A pass from the front computes T and keeps it in by_tau; one from the back computes S. The second pass alone would
    need T_i = T_{i+1} / (1 − α_i), a division by 0 at an opaque sample.
    """
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = r < count
    first = tl.load(row_offsets + r, mask=real, other=0)
    last = tl.load(row_offsets + r + 1, mask=real, other=0)
    gr = tl.load(gradient + r * 3, mask=real, other=0.0)
    gg = tl.load(gradient + r * 3 + 1, mask=real, other=0.0)
    gb = tl.load(gradient + r * 3 + 2, mask=real, other=0.0)
    most = tl.max(last - first)
    transmittance = tl.full((BLOCK,), 1.0, tl.float32)
    for s in range(most):
        at = first + s
        some = real & (at < last)
        left = tl.exp(-tl.load(tau + at, mask=some, other=0.0))
        w = transmittance * (1 - left)
        transmittance *= left
        tl.store(by_tau + at, transmittance, mask=some)
        tl.store(by_rgb + at * 3, w * gr, mask=some)
        tl.store(by_rgb + at * 3 + 1, w * gg, mask=some)
        tl.store(by_rgb + at * 3 + 2, w * gb, mask=some)
    shown = tl.load(background) * gr + tl.load(background + 1) * gg + tl.load(background + 2) * gb
    behind = transmittance * shown
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
    table, gradient, mean, square, count, numbers, epsilon, BETA1: tl.constexpr, BETA2: tl.constexpr,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One step of Adam on the rows that have a gradient; the gradient is then cleared."""
    rate, correction1, correction2 = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    at = row[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :]
    real = (row < count)[:, None]
    g = tl.load(gradient + at, mask=real, other=0.0)
    some = real & (tl.max(tl.abs(g), axis=1) > 0)[:, None]
    m = BETA1 * tl.load(mean + at, mask=some, other=0.0) + (1 - BETA1) * g
    v = BETA2 * tl.load(square + at, mask=some, other=0.0) + (1 - BETA2) * g * g
    p = tl.load(table + at, mask=some, other=0.0)
    tl.store(table + at, p - rate * (m * correction1) / (tl.sqrt(v * correction2) + epsilon), mask=some)
    tl.store(mean + at, m, mask=some)
    tl.store(square + at, v, mask=some)
    tl.store(gradient + at, tl.zeros_like(g), mask=some)
