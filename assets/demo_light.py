"""The light of the demo scene: a studio to be mirrored, a key light with soft shadows, ambient occlusion.

All in closed form or by a convergent search, so that light is a definite function of the place.
"""

from __future__ import annotations

import numpy as np
from demo_shapes import Array, Shape, Torus, dot, unit
from numpy.typing import NDArray

KEY = unit(np.array([0.22, -0.78, 0.92]))  # towards the large soft box that casts the shadows
KEY_SPREAD = 0.11  # its angular radius in radians, as the shadows see it
KEY_LIGHT = 1.04 * np.array([1.0, 0.93, 0.84])
SKY, HORIZON = np.array([0.50, 0.55, 0.64]), np.array([0.34, 0.33, 0.33])
BOUNCE = np.array([0.40, 0.36, 0.31])  # what the lit plinth sends back up
NEAREST = 1e-3  # shadows are looked for from this far on: d(s)/s needs s > 0
# soft boxes: towards the middle, half width, half height (tangents of angles), radiance
BOXES = (
    (KEY, 0.42, 0.42, 15.0 * np.array([1.0, 0.95, 0.88])),
    (unit(np.array([0.95, 0.45, 0.42])), 0.16, 0.62, 9.0 * np.array([0.86, 0.93, 1.0])),
    (unit(np.array([-0.75, 0.80, 0.55])), 0.22, 0.50, 7.0 * np.array([1.0, 0.93, 0.85])),
    (unit(np.array([-0.90, -0.38, 0.30])), 0.12, 0.45, 6.0 * np.array([0.90, 0.95, 1.0])),
)


def smooth(x: Array) -> Array:
    """0 below 0, 1 above 1, 3x² − 2x³ between."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def environment(directions: Array, blur: float) -> Array:
    """The studio's linear radiance from unit directions (P, 3): a gradient and soft boxes with edges `blur` wide."""
    up = directions[:, 2:3]
    light = HORIZON + (1.5 * SKY - HORIZON) * smooth(up * 0.9 + 0.1)
    for middle, half_width, half_height, colour in BOXES:
        sideways = unit(np.cross([0.0, 0.0, 1.0], middle))
        facing = directions @ middle
        depth = np.maximum(facing, 1e-6)  # behind the box's horizon `facing` masks the quotient
        x = np.abs(directions @ sideways) / depth
        y = np.abs(directions @ np.cross(middle, sideways)) / depth
        inside = smooth((half_width - x) / blur + 0.5) * smooth((half_height - y) / blur + 0.5) * (facing > 0)
        light = light + inside[:, None] * colour
    return light


def lit_past(shape: Shape, points: Array) -> Array:
    """How much of the key light points (P, 3) see past one solid, (P,) in [0, 1].

    The light is a disc of angular radius KEY_SPREAD. With d(s) the distance from the solid to the place s along the
    ray to the disc's middle, min d(s)/s is about the angle by which the solid clears that ray. Hidden is what a band
    from this angle on covers of the disc, as wide as the solid looks from the nearest place.
    """
    indices, s, gap = _ring_clearance(shape, points) if isinstance(shape, Torus) else _clearance(shape, points)
    start = gap / (KEY_SPREAD * s)
    end = start + 2 * shape.width / (KEY_SPREAD * s)
    visible = np.ones(len(points))
    visible[indices] -= smooth(0.5 + end / 2) - smooth(0.5 + start / 2)
    return visible


def _ring_clearance(ring: Torus, points: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Points that may lie in the ring's shadow (as indices), the s at which their key ray comes past, its distance.

    Where the ray cuts the ring's plane, at radius ρ, the wire is | ρ − R | / |∇ρ| away, to first order.
    """
    tilt = KEY @ ring.axis
    offset = points - ring.centre
    s = -(offset @ ring.axis) / tilt
    flat = offset + s[:, None] * KEY
    rho = np.linalg.norm(flat, axis=-1)
    radial = flat / np.maximum(rho, 1e-12)[:, None]  # in the ring's middle every direction is as far from the wire
    slope = np.linalg.norm(radial - (radial @ KEY / tilt)[:, None] * ring.axis, axis=-1)
    indices = np.flatnonzero(s > NEAREST)
    return indices, s[indices], (np.abs(rho - ring.major) / slope)[indices] - ring.width


def _clearance(shape: Shape, points: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """The same for a convex solid: d(s) is convex, so d(s)/s has one minimum, which golden sections close in on."""
    golden = (np.sqrt(5) - 1) / 2
    offset = shape.centre - points
    middle = offset @ KEY
    apart = np.linalg.norm(offset - middle[:, None] * KEY, axis=-1)
    reach = middle + 2 * shape.bound
    indices = np.flatnonzero((reach > NEAREST) & (apart < shape.bound + KEY_SPREAD * reach))
    low, high = np.maximum(middle - shape.bound, NEAREST)[indices], reach[indices]
    place = points[indices]

    def slope(s: Array) -> Array:
        return shape.distance(place + s[:, None] * KEY) / s

    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left, at_right = slope(left), slope(right)
    for _ in range(24):  # 0.618²⁴ ≈ 1e-5 of the stretch
        lower = at_left < at_right
        low, high = np.where(lower, low, left), np.where(lower, right, high)
        fresh = np.where(lower, high - golden * (high - low), low + golden * (high - low))
        at_fresh = slope(fresh)
        left, right = np.where(lower, fresh, right), np.where(lower, left, fresh)
        at_left, at_right = np.where(lower, at_fresh, at_right), np.where(lower, at_left, at_fresh)
    s = (low + high) / 2
    return indices, s, slope(s) * s


def occlusion(points: Array, normals: Array, centre: Array, radius: float) -> Array:
    """Cosine-weighted part of the hemisphere that a sphere hides, (P,): (n·c) r²/|c|³, faded below the horizon."""
    offset = centre - points
    length = np.linalg.norm(offset, axis=-1)
    height = dot(offset, normals)
    sunk = np.clip((height + radius) / (2 * radius), 0, 1) ** 1.5 * radius
    return np.clip(np.where(height < radius, sunk, height) * radius**2 / length**3, 0, 1)
