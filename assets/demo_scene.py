"""A still life whose depth, normals and emitted radiance are definite functions: the truth for the demo scene.

A glossy blue ball, a patterned vase with thin stems, and a brass ring on a terrazzo plinth, z up, inside a ball of
radius 1.3 around the origin. `hit` gives the first surface of a ray, `radiance` what a surface point sends towards
the eye, `render` a picture. Light is computed in linear RGB and returned sRGB-encoded, as the pictures store it.
Approximations (soft shadows, ambient occlusion, one mirror bounce) are part of the definition: there is no noise.
"""

from __future__ import annotations

import numpy as np
from demo_light import BOUNCE, HORIZON, KEY, KEY_LIGHT, SKY, environment, lit_past, occlusion, smooth
from demo_shapes import Array, Capsule, RoundedCylinder, Shape, Sphere, Torus, dot, unit
from numpy.typing import NDArray

NEAR, FAR = 2.0, 6.0
MISS, PLINTH, BALL, VASE, RING, STEM, BUD = -1, 0, 1, 2, 3, 4, 5
GLOSSY = (BALL, RING)

Ids = NDArray[np.int64]


def srgb(*rows: str) -> Array:
    """Hex colours → linear RGB (N, 3), or (3,) for one (IEC 61966-2-1)."""
    encoded = np.array([[int(row[i : i + 2], 16) for i in (0, 2, 4)] for row in rows]) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear[0] if len(rows) == 1 else linear


def encode(linear: Array) -> Array:
    """Linear RGB ≥ 0 → sRGB-encoded [0, 1], highlights above 0.8 rolled off smoothly towards white."""
    knee = 0.8
    over = np.maximum(linear - knee, 0) / (1 - knee)
    x = np.minimum(linear, knee) + (1 - knee) * np.tanh(over)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


# --- what stands where ---------------------------------------------------------------------------------------------

TOP = -0.60  # height of the plinth's surface
AXIS = np.array([0.8899, -0.4561, 0.0]) / np.hypot(0.8899, 0.4561)  # from vase to ball; the ring stands across it
VASE_AT = -0.46 * AXIS
BALL_AT = 0.46 * AXIS + np.array([0, 0, TOP + 0.40])
MOUTH = VASE_AT + np.array([0, 0, 0.10])
BUDS = np.array([[-0.66, 0.12, 0.56], [-0.40, 0.40, 0.76], [-0.24, 0.10, 0.47], [-0.56, 0.36, 0.38]])
BUD_RADII = (0.085, 0.095, 0.075, 0.070)

WIRE = Torus(np.array([0.0, 0.0, TOP + 0.62]) - 0.03 * AXIS, AXIS, 0.60, 0.020)
BODY = RoundedCylinder(VASE_AT + np.array([0, 0, TOP + 0.31]), 0.29, 0.31, 0.11)
SHAPES: tuple[tuple[int, Shape], ...] = (
    (PLINTH, RoundedCylinder(np.array([0, 0, TOP - 0.065]), 1.05, 0.065, 0.02)),
    (BALL, Sphere(BALL_AT, 0.40)),
    (VASE, BODY),
    (VASE, RoundedCylinder(MOUTH - np.array([0, 0, 0.08]), 0.110, 0.08, 0.02)),
    (VASE, Torus(MOUTH, np.array([0.0, 0.0, 1.0]), 0.105, 0.024)),
    (RING, WIRE),
    *((STEM, Capsule(MOUTH + 0.06 * unit(end - MOUTH) * [1, 1, 0], end, 0.011)) for end in BUDS),
    *((BUD, Sphere(end, radius)) for end, radius in zip(BUDS, BUD_RADII, strict=True)),
)


def hit(origins: Array, directions: Array) -> tuple[Array, Array, Ids]:
    """The first surface along rays from outside the solids.

    origins, directions: (R, 3), unit directions. Returns t (R,) in scene units (inf for misses), outward unit normals
    (R, 3) (zero for misses) and object ids (R,) (MISS for misses). Spheres in closed form, the other solids
    sphere-traced to 1e-9 (see demo_shapes).
    """
    t = np.full(len(origins), np.inf)
    which = np.full(len(origins), -1)
    for index, (_, shape) in enumerate(SHAPES):
        candidate = shape.hit(origins, directions)
        closer = candidate < t
        t[closer], which[closer] = candidate[closer], index
    normals = np.zeros_like(origins)
    ids = np.full(len(origins), MISS)
    for index, (name, shape) in enumerate(SHAPES):
        mine = which == index
        normals[mine] = shape.normal(origins[mine] + t[mine, None] * directions[mine])
        ids[mine] = name
    return t, normals, ids


# --- light -------------------------------------------------------------------------------------------------------


def openness(points: Array, normals: Array, ids: Ids) -> Array:
    """Share of the ambient light that reaches points (P,), past ball, vase and buds.

    On the plinth the vase is a wall of height h that fills 2 asin(r/ρ) of the horizon: it hides
    asin(r/ρ)/π · h²/(h² + (ρ − r)²) of the cosine-weighted sky.
    """
    ball = np.where(ids == BALL, 0.0, occlusion(points, normals, BALL_AT, 0.40))
    rho = np.maximum(np.hypot(*(points - VASE_AT)[:, :2].T), BODY.radius)
    height = 2 * BODY.half
    wall = np.arcsin(BODY.radius / rho) / np.pi * height**2 / (height**2 + (rho - BODY.radius) ** 2)
    round_body = occlusion(points, normals, BODY.centre, 0.30)
    vase = np.where(ids == PLINTH, wall * np.maximum(normals[:, 2], 0), np.where(ids == VASE, 0.0, round_body))
    result = (1 - 0.95 * ball) * (1 - 1.3 * vase)
    for end, radius in zip(BUDS, BUD_RADII, strict=True):
        result *= np.where(ids == BUD, 1.0, 1 - 0.8 * occlusion(points, normals, end, radius))
    return result


def irradiance(points: Array, normals: Array, ids: Ids) -> Array:
    """Linear light (P, 3) that a white matte surface would send back: key light with soft shadows, sky and bounce."""
    key = np.maximum(normals @ KEY, 0)
    lit = np.flatnonzero(key > 0)
    for _, shape in SHAPES:
        key[lit] *= lit_past(shape, points[lit])
    up = normals[:, 2:3] / 2 + 0.5
    above = np.maximum(points[:, 2:3] - TOP, 0)
    # near its surface the plinth lies in the shadow of what stands on it; far above it fills less of the view
    bounce = np.where(ids[:, None] == PLINTH, HORIZON, BOUNCE * above / (above + 0.10) / (1 + above**2))
    ambient = (SKY * up + bounce * (1 - up)) * openness(points, normals, ids)[:, None]
    return key[:, None] * KEY_LIGHT + ambient


# --- materials -----------------------------------------------------------------------------------------------------

CREAM, CLAY, CLAY_DARK = srgb("f3e8d6"), srgb("c4714f"), srgb("3a201a")
BLUE, BRASS, SAGE, MUSTARD = srgb("0e2f72"), srgb("f2cf86"), srgb("77835c"), srgb("e6aa2e")
STONE = srgb("e2d7c8")
CHIPS = srgb("c98a6c", "8fa3b8", "d9b46a", "b9ada0", "f7f2ea", "6f7f93")


def hashed(cells: NDArray[np.int64], salt: int) -> Array:
    """Integer cells (P, 3) → [0, 1) (P,): the same on every machine (a murmur3 finaliser)."""
    h = (cells.astype(np.uint32) * np.array([0x8DA6B343, 0xD8163841, 0xCB1AB31F], dtype=np.uint32)).sum(-1)
    h = h.astype(np.uint32) ^ np.uint32(salt * 0x9E3779B1 & 0xFFFFFFFF)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    return h / 2.0**32


def terrazzo(points: Array) -> Array:
    """Stone with embedded chips: some of the Voronoi cells of a jittered grid, shrunk (P, 3)."""
    scaled = points / 0.135
    corner = np.floor(scaled).astype(np.int64)
    first, second = np.full((2, len(points)), np.inf)
    owner = np.zeros_like(corner)
    for offset in np.ndindex(3, 3, 3):
        cell = corner + (np.array(offset) - 1)
        seed = cell + np.stack([hashed(cell, k) for k in (1, 2, 3)], -1)
        d = np.linalg.norm(scaled - seed, axis=-1)
        second = np.minimum(second, np.maximum(first, d))
        owner[d < first] = cell[d < first]
        first = np.minimum(first, d)
    margin = 0.12 + 0.25 * hashed(owner, 4)
    chip = smooth((second - first - margin) / 0.06) * (hashed(owner, 5) < 0.62)
    tint = CHIPS[(hashed(owner, 6) * len(CHIPS)).astype(int)]
    return STONE + (tint - STONE) * 0.9 * chip[:, None]


def glaze(points: Array) -> Array:
    """The vase (P, 3): terracotta with a cream belt of zigzag lines, cream lines at foot and shoulder, a dark mouth."""
    local = points - VASE_AT
    around = np.arctan2(local[:, 1], local[:, 0]) * 10 / (2 * np.pi)
    zigzag = np.abs(around - np.floor(around) - 0.5)
    z = local[:, 2] - TOP
    wave = (z - 0.33) / 0.085 - 1.5 * (zigzag - 0.25)
    belt = smooth((1.5 - np.abs(wave)) / 0.1) * smooth((0.27 - np.abs(wave - np.round(wave))) / 0.08)
    lines = sum(smooth((0.011 - np.abs(z - height)) / 0.006) for height in (0.13, 0.53))
    cream = np.clip(belt + lines, 0, 1)[:, None]
    mouth = (np.hypot(local[:, 0], local[:, 1]) < 0.10) & (z > 0.695)
    return np.where(mouth[:, None], CLAY_DARK, CLAY + (CREAM - CLAY) * cream)


def albedo(points: Array, ids: Ids) -> Array:
    """Linear diffuse reflectance (P, 3); brass has none."""
    colours = np.zeros_like(points)
    for name, texture in ((PLINTH, terrazzo), (VASE, glaze)):
        colours[ids == name] = texture(points[ids == name])
    for name, colour in ((BALL, BLUE), (STEM, SAGE), (BUD, MUSTARD)):
        colours[ids == name] = colour
    return colours


def shade(points: Array, normals: Array, ids: Ids, outgoing: Array, bounces: int) -> Array:
    """Linear radiance (P, 3) towards unit `outgoing` (P, 3): matte, and mirror with Schlick's Fresnel on GLOSSY."""
    light = albedo(points, ids) * irradiance(points, normals, ids)
    for name, blur in ((BALL, 0.10), (RING, 0.35)):
        mine = np.flatnonzero(ids == name)
        n, v = normals[mine], outgoing[mine]
        cosine = np.clip(dot(n, v), 0, 1)[:, None]
        mirror = 2 * dot(n, v)[:, None] * n - v
        incoming = environment(mirror, blur)
        if bounces:
            start = points[mine] + 1e-6 * n  # off the surface, so that the mirrored ray does not meet it again
            t, hit_n, hit_id = hit(start, mirror)
            met = np.flatnonzero(np.isfinite(t))
            at = start[met] + t[met, None] * mirror[met]
            incoming[met] = shade(at, hit_n[met], hit_id[met], -mirror[met], bounces - 1)
        f0 = BRASS if name == RING else np.full(3, 0.045)
        fresnel = f0 + (1 - f0) * (1 - cosine) ** 5
        light[mine] = light[mine] * (1 - fresnel) + incoming * fresnel
    return light


def radiance(points: Array, normals: Array, object_id: Ids, outgoing: Array) -> Array:
    """sRGB-encoded radiance (P, 3) in [0, 1] that surface points send towards unit `outgoing` v (P, 3), v = −d.

    Matte objects ignore v altogether; those in GLOSSY mirror the studio and, once, the rest of the scene.
    """
    return encode(shade(points, normals, object_id, outgoing, bounces=1))


def render(c2w: Array, width: int, height: int, camera_angle_x: float, supersample: int) -> Array:
    """The picture of a camera (OpenGL axes, Blender's horizontal angle): (height, width, 4) in [0, 1], straight alpha.

    Each pixel is the mean of supersample² rays, of the sRGB-encoded values: compositing in that space is what a NeRF
    trained on such pictures does.
    """
    focal = width / 2 / np.tan(camera_angle_x / 2)
    columns, rows = ((np.arange(count * supersample) + 0.5) / supersample for count in (width, height))
    x, y = np.meshgrid((columns - width / 2) / focal, (height / 2 - rows) / focal)
    directions = unit(np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3) @ c2w[:3, :3].T)
    origins = np.broadcast_to(c2w[:3, 3], directions.shape)
    t, normals, ids = hit(origins, directions)
    seen = np.flatnonzero(ids != MISS)
    rays = np.zeros((len(t), 4))
    points = origins[seen] + t[seen, None] * directions[seen]
    rays[seen, :3] = radiance(points, normals[seen], ids[seen], -directions[seen])
    rays[seen, 3] = 1
    mean = rays.reshape(height, supersample, width, supersample, 4).mean((1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-9)  # where nothing is seen colour is zero already
    return mean
