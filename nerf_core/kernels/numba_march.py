"""March along a ray on a CPU: steps of equal length through occupied cells, leaps over empty blocks.

`nerf_core.kernels.torch_march` is the plain reference. `cells` is `nerf_core.volume.cells.CellArrays`.
All arithmetic is float32. An integer among the operands would silently make it float64.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from nerf_core.common.jit.vectors import inlined, jit

F = np.float32
NEVER = F(1e30)
STEPPED = F(2**-22)  # shortest step, relative to t: two float32 spacings. A shorter one might not change t at all.
STRAIGHT = F(0.1)  # longest leap of a contracted ray, relative to its distance from the centre: it curves
NEARING = F(0.25)  # longest step towards the centre, relative to the same: far outside one would cross the scene
# The columns of `notes`, one row a sample. The cell and the position in it are overwritten by the results there.
# The cell is stored rather than computed again from the position: after one more rounding the position might lie in
# the neighbouring cell, which may be empty.
ALPHA, TRANSMITTANCE, RED, GREEN, BLUE, RAW, DISTANCE, WIDTH, NOTES = 0, 1, 2, 3, 4, 5, 6, 7, 8
CELL_X, CELL_Y, CELL_Z, X, Y, Z = ALPHA, TRANSMITTANCE, RAW, RED, GREEN, BLUE


@inlined
def _gap(x: Any, v: Any, low: Any, high: Any) -> Any:
    """The t until a point at x with velocity v leaves [low, high]; NEVER for v = 0."""
    return NEVER if v == 0 else max((low - x) / v, (high - x) / v)


@inlined
def _clipped(x: Any, v: Any, side: Any, first: Any, last: Any) -> Any:
    """The part of [first, last] in which x + t v lies in [0, side]; empty if there is none."""
    if v == 0:
        return (first, last) if 0 <= x <= side else (first, F(-1))
    a, b = -x / v, (side - x) / v
    return max(first, min(a, b)), min(last, max(a, b))


@inlined
def _bent(wx: Any, wy: Any, wz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """f, f′ and ‖x‖∞ of a contracted point x → f x, f = (2 − s) s, s = 1/‖x‖∞. Its velocity is f d + f′ x."""
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


class Way(NamedTuple):
    """What a march needs to know about a ray. Position g + t v and velocity v are in cells, as without contraction."""

    gx: Any
    gy: Any
    gz: Any
    vx: Any
    vy: Any
    vz: Any
    ox: Any
    oy: Any
    oz: Any
    dx: Any
    dy: Any
    dz: Any
    last: Any
    straight: Any  # Δt of a step without contraction
    length: Any  # of a unit of t, in box coordinates like the norm


@inlined
def enter(cells: Any, rays: Any, r: Any, step: Any) -> Any:
    """Return the way of ray r, and the t where its march begins."""
    nx, ny, nz = cells.size[0], cells.size[1], cells.size[2]
    sx, sy, sz = cells.scale[0], cells.scale[1], cells.scale[2]
    ox, oy, oz = rays.origins[r, 0], rays.origins[r, 1], rays.origins[r, 2]
    dx, dy, dz = rays.directions[r, 0], rays.directions[r, 1], rays.directions[r, 2]
    gx, gy, gz = (ox - cells.origin[0]) * sx, (oy - cells.origin[1]) * sy, (oz - cells.origin[2]) * sz
    vx, vy, vz = dx * sx, dy * sy, dz * sz
    t, last = rays.near[r], rays.far[r]
    if not cells.contracted:
        t, last = _clipped(gx, vx, F(nx), t, last)
        t, last = _clipped(gy, vy, F(ny), t, last)
        t, last = _clipped(gz, vz, F(nz), t, last)
    length = F(math.sqrt(dx * dx + dy * dy + dz * dz))
    straight = step / F(math.sqrt(vx * vx + vy * vy + vz * vz))
    t += rays.offsets[r] * straight
    if not (straight > 0 and F(0) * (ox + oy + oz) == 0):  # NaN or infinity in the ray: it has no samples
        last = F(-1)
        t = F(0)
    return Way(gx, gy, gz, vx, vy, vz, ox, oy, oz, dx, dy, dz, last, straight, length), t


@jit
def march(cells: Any, rays: Any, r: Any, step: Any, notes: Any) -> Any:
    """Find the samples of ray r in occupied cells, front to back; see `advance`. Returns how many there are."""
    way, t = enter(cells, rays, r, step)
    return advance(cells, way, step, t, notes, 0, notes.shape[0] // NOTES)[0]


@inlined
def advance(cells: Any, way: Any, step: Any, t: Any, notes: Any, n: Any, most: Any) -> Any:  # noqa: PLR0915  one loop, with all that it needs in registers
    """Find the samples of a ray from t on, until it has `most`.

    Writes each one's cell, position in it, t and Δt to `notes`, from the n-th on. Returns how many there are now, and
    the t where to go on. A cell whose sides were doubled d times is counted in cells of its size, with d << 12 added
    along x.
    """
    nx, ny, nz = cells.size[0], cells.size[1], cells.size[2]
    blocks_y, blocks_z = (ny + 3) >> 2, (nz + 3) >> 2
    sx, sy, sz = cells.scale[0], cells.scale[1], cells.scale[2]
    bx, by, bz = cells.origin[0], cells.origin[1], cells.origin[2]
    gx, gy, gz, vx, vy, vz, ox, oy, oz, dx, dy, dz, last, straight, length = way
    ux, uy, uz, norm = vx, vy, vz, F(0)
    while t < last and n < most:
        px, py, pz = gx + t * vx, gy + t * vy, gz + t * vz
        dt, bent_inwards = straight, False
        if cells.contracted:
            wx, wy, wz = ox + t * dx, oy + t * dy, oz + t * dz
            f, slope, norm = _bent(wx, wy, wz, dx, dy, dz)
            ux, uy, uz = vx, vy, vz
            if norm > 1:
                px, py, pz = (wx * f - bx) * sx, (wy * f - by) * sy, (wz * f - bz) * sz
                ux, uy, uz = (dx * f + wx * slope) * sx, (dy * f + wy * slope) * sy, (dz * f + wz * slope) * sz
                dt = step / math.sqrt(ux * ux + uy * uy + uz * uz)
                bent_inwards = slope > 0
                if bent_inwards:
                    dt = min(dt, NEARING * norm / length)
        dt = max(dt, t * STEPPED)
        # Outside by rounding at the border; or NaN, which must not become the index of a cell.
        if not (px >= 0 and py >= 0 and pz >= 0 and px < F(nx) and py < F(ny) and pz < F(nz)):
            t += dt
            continue
        i, j, k = int(px), int(py), int(pz)
        leap = cells.leap[np.uint64(((i >> 2) * blocks_y + (j >> 2)) * blocks_z + (k >> 2))]
        if leap > 0:  # the blocks up to leap − 1 away are empty: go to the far side of the cube that they form
            reach = 4 * (np.int64(leap) - 1)
            x, y, z = F((i & ~3) - reach), F((j & ~3) - reach), F((k & ~3) - reach)
            side = F(4 + 2 * reach)
            gap = min(_gap(px, ux, x, x + side), _gap(py, uy, y, y + side), _gap(pz, uz, z, z + side))
            if norm > 1:
                gap = min(gap, STRAIGHT * norm / length)
            t += max(np.floor(gap / dt) + F(1), F(1)) * dt
            continue
        kind = cells.kinds[np.uint64((i * ny + j) * nz + k)]
        if kind == 0:
            t += dt
        else:
            at = n * NOTES
            if kind == 1:
                notes[at + CELL_X], notes[at + CELL_Y], notes[at + CELL_Z] = F(i), F(j), F(k)
                notes[at + X], notes[at + Y], notes[at + Z] = px - F(i), py - F(j), pz - F(k)
            else:  # a larger cell: its steps are longer
                d = np.int64(kind) - 1
                i, j, k = i >> d, j >> d, k >> d
                share = F(1) / F(1 << d)
                notes[at + CELL_X], notes[at + CELL_Y], notes[at + CELL_Z] = F(i + (d << 12)), F(j), F(k)
                notes[at + X], notes[at + Y], notes[at + Z] = px * share - F(i), py * share - F(j), pz * share - F(k)
                dt *= F(1 << d)
                if bent_inwards:
                    dt = min(dt, NEARING * norm / length)
            notes[at + DISTANCE] = t
            notes[at + WIDTH] = dt
            n += 1
            t += dt
    return n, t
