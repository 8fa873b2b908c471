"""The photo that the study shows if none is given: balloons over a mountain lake, drawn by this script.

It has what natural photos have: detail of all sizes whose power falls with the frequency, sharp edges, smooth areas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerf_core.lab.sample_noise import Array, F, fractal, linear, mix, noise, smooth
from nerf_core.lab.sample_terrain import (
    EYE,
    FARTHEST,
    FOCAL,
    SHORE,
    SKYLIGHT,
    SUN,
    SUNLIGHT,
    distances,
    pixel_directions,
    shaded,
)

HORIZON = 0.665  # its row from the top, as a share of the picture
SUPERSAMPLE = 2  # rays along each side of a pixel
KNEE = 0.75  # linear light above it is rolled off towards white


class _Canvas(NamedTuple):
    """A picture in work.

    color: (n, n, 3) linear RGB.
    x, y: (n, n) places of the pixels, to the right from the middle and up from the horizon, in heights of the picture.
    z: (n, n) distances of the land; inf elsewhere.
    """

    color: Array
    x: Array
    y: Array
    z: Array


def sample_photo(size: int = 512) -> np.ndarray:
    """Draw the photo, (size, size, 3) float32 in [0, 1], sRGB-encoded; it takes about 4 s on one core at 512.

    The same size gives the same picture every time. Smaller pictures are drawn with less fine detail.
    """
    n = size * SUPERSAMPLE
    middle = (np.arange(n, dtype=F) + F(0.5)) / F(n)
    x, y = (v.copy() for v in np.broadcast_arrays(middle[None] - F(0.5), F(HORIZON) - middle[:, None]))
    canvas = _Canvas(np.zeros((n, n, 3), F), x, y, distances(n, HORIZON))
    for draw in (_sky, _land, _balloons, _lake, _bank, _pines):
        draw(canvas)
    return _encoded(canvas.color.reshape(size, SUPERSAMPLE, size, SUPERSAMPLE, 3).mean((1, 3)))


def _encoded(light: Array) -> np.ndarray:
    """Encode linear light ≥ 0 with the sRGB curve (IEC 61966-2-1) after rolling off what is brighter than KNEE."""
    light = np.minimum(light, KNEE) + (1 - KNEE) * np.tanh(np.maximum(light - KNEE, 0) / (1 - KNEE))
    curve = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.clip(np.where(light <= 0.0031308, 12.92 * light, curve), 0, 1).astype(np.float32)


def _sky(canvas: _Canvas) -> None:
    """A gradient with wisps of cloud, above the horizon."""
    above = canvas.y > -0.01
    x, y = canvas.x[above], canvas.y[above]
    up = y / HORIZON
    color = mix(linear("fbd9b4"), linear("a8c0e0"), smooth(up / 0.5))
    color = mix(color, linear("3565ad"), smooth((up - 0.25) / 0.85))
    u, v = x * 2.2 + y * 0.9 + 5, y * 9 - x * 2.3 + 2  # stretched along the wind
    drift = 0.9 * fractal(u * 0.7, v * 0.7, 3, 77)
    cloud = smooth((fractal(u + drift, v + drift, 6, 71, gain=0.55) + 0.05) / 0.75)
    canvas.color[above] = mix(color, np.array([1.1, 0.93, 0.82], F), 0.8 * cloud * smooth(y / 0.15))


def _land(canvas: _Canvas) -> None:
    n, seen = len(canvas.z), np.isfinite(canvas.z)
    z = canvas.z[seen]
    x = np.broadcast_to(pixel_directions(n), (n, n))[seen] * z
    canvas.color[seen] = shaded(x, z, octaves=max(4, round(np.log2(n))))  # down to the size of a pixel


# --- balloons ------------------------------------------------------------------------------------------------------

# x, y, radius, and the colours of the stripes, the belt, the zigzag in it, and the mouth
BALLOONS = (
    (0.245, 0.37, 0.118, "c8371f f1e3c4 e29a21 f1e3c4", "153e63", "f0b43c", "8d2415"),
    (-0.395, 0.50, 0.060, "1f7a74 f1e3c4", "f0b43c", "b8361f", "14504d"),
    (0.030, 0.535, 0.043, "e8a728 b8361f", "f1e3c4", "5a2a5e", "5a2a5e"),
    (0.415, 0.57, 0.024, "35508f f1e3c4 c8371f f1e3c4", "f1e3c4", "35508f", "243a6b"),
)  # fmt: skip
ROPE, WICKER = linear("3a2a1e"), linear("8a5a30")


def _balloons(canvas: _Canvas) -> None:
    for x, y, radius, stripes, *trim in BALLOONS:
        near = (np.abs(canvas.x - x) < 1.1 * radius) & (np.abs(canvas.y - y) < 1.8 * radius)
        u, v = (canvas.x[near] - x) / radius, (canvas.y[near] - y) / radius
        color = canvas.color[near]
        _envelope(color, u, v, [linear(one) for one in stripes.split()], [linear(one) for one in trim])
        _basket(color, u, v)
        canvas.color[near] = color


def _envelope(color: Array, u: Array, v: Array, stripes: list[Array], trim: list[Array]) -> None:
    """Draw a balloon of radius 1 around (0, 0) over colours (P, 3) at (u, v), v upwards."""
    low = np.clip(-(v + 0.05) / 1.3, 0, 1)  # from the widest place, 0, to the mouth, 1
    dome = np.sqrt(np.clip(1 - ((v + 0.05) / 1.02) ** 2, 0, 1))
    radius = np.where(v > -0.05, dome, 1 - 0.8 * low**1.9 * (1.12 - 0.12 * low))
    inside = (np.abs(u) < radius) & (v > -1.36) & (v < 0.97)
    u, v, radius = u[inside], v[inside], radius[inside]
    side = np.clip(u / np.maximum(radius, 1e-3), -1, 1)  # the top of the dome has no width
    gore, across = np.divmod((np.arcsin(side) + 0.22) * 16 / np.pi, 1)
    cloth = np.stack(stripes)[gore.astype(int) % len(stripes)]
    belt, line, mouth = trim
    zigzag = np.abs(v + 0.10 - 0.24 * np.abs(across - 0.5))
    cloth[zigzag < 0.20], cloth[zigzag < 0.055] = belt, line
    cloth[v > 0.80], cloth[v < -1.02] = belt, mouth

    up = 0.85 * np.clip(v + 0.15, -1, 1)
    level = np.sqrt(1 - up**2)
    normal = np.stack([0.98 * side * level, up, -np.sqrt(1 - side**2) * level], -1)
    puffed = 1 - 0.3 * (1 - np.cos((across - 0.5) * np.pi))
    sun = np.maximum(normal @ SUN, 0) * puffed + 0.22 * (0.5 + 0.5 * side)  # some light shines through the cloth
    color[inside] = cloth * (0.62 * sun[:, None] * SUNLIGHT + 1.1 * (0.55 + 0.3 * up)[:, None] * SKYLIGHT)


def _basket(color: Array, u: Array, v: Array) -> None:
    """Draw the ropes and the basket below a balloon of radius 1."""
    ropes = (np.abs(np.abs(u) - 0.10 - 0.32 * (v + 1.5)) < 0.011) & (v > -1.56) & (v < -1.3)
    color[ropes] = ROPE
    basket = (np.abs(u) < 0.115) & (np.abs(v + 1.62) < 0.085)
    u, v = u[basket], v[basket]
    weave = np.where((np.floor(u * 60) + np.floor(v * 60)) % 2 > 0, 1.3, 0.8)
    color[basket] = WICKER * (weave * (0.45 + 0.5 * np.clip(u / 0.12, 0, 1)))[:, None]


# --- lake and foreground -------------------------------------------------------------------------------------------


def _lake(canvas: _Canvas) -> None:
    """Water that mirrors what is above it, moved by ripples."""
    n = len(canvas.z)
    water = ~np.isfinite(canvas.z) & (canvas.y < -EYE * FOCAL / FARTHEST)
    rows, columns = np.nonzero(water)
    x, y = canvas.x[water], canvas.y[water]
    z = EYE * FOCAL / -y
    ripple, wavelet = fractal(x / FOCAL * z * 5, z * 9, 4, 61), fractal(x / FOCAL * z * 16 + 3, z * 34, 2, 66)
    strength = n * (0.010 + 0.012 * np.clip(1 - z / 4, 0, 1))
    down, across = (0.8 * ripple + 0.5 * wavelet) * strength, 0.35 * ripple * strength
    # Height h at distance d is seen at the row n (HORIZON − FOCAL (h − EYE) / d), its mirror image at
    # n (HORIZON + FOCAL (h + EYE) / d). d is that of what is mirrored: it is looked up and the row computed again.
    column = np.clip(columns + across, 0, n - 1).astype(int)
    d = np.full(len(rows), 13.0, F)
    row = rows
    for _ in range(3):
        row = np.clip(n * (2 * HORIZON + 2 * FOCAL * EYE / d) - (rows + 0.5) + down, 0, n - 1).astype(int)
        d = np.clip(canvas.z[row, column], SHORE, 60)  # the sky is far away
    first = np.argmax(water, 0)  # the uppermost row of water
    row = np.where(water[row, column], first[column] - 2, row)
    steepness = np.clip(-y / FOCAL, 0, 1)  # water mirrors less where one looks down into it
    share = np.clip(0.80 - 1.3 * steepness - 0.12 * ripple, 0, 1)
    color = mix(np.array([0.020, 0.060, 0.075], F), canvas.color[row, column] * np.array([0.86, 0.92, 0.96], F), share)
    glint = 0.25 * smooth((wavelet + 0.5 * ripple - 0.42) / 0.2)
    canvas.color[water] = color + glint[:, None] * np.array([1, 0.85, 0.7], F)

    at = np.arange(n)[:, None]
    stones = water & (at < first + 0.003 * n * (1 + 1.4 * noise(canvas.x * 40, np.zeros_like(canvas.x), 67)))
    canvas.color[stones] = 0.5 * canvas.color[stones] + np.array([0.13, 0.115, 0.09], F)


def _bank(canvas: _Canvas) -> None:
    """Grass with flowers along the lower edge."""
    low = canvas.y < 0.22 + HORIZON - 1
    x, y = canvas.x[low], canvas.y[low] + F(1 - HORIZON)  # upwards from the lower edge
    top = 0.085 + 0.055 * np.clip(-1.7 * (x + 0.15), -0.5, 1) + 0.03 * np.clip(2.5 * (x - 0.22), 0, 1)
    top = top + 0.014 * fractal(x * 6, np.full_like(x, 3), 3, 91)
    blades = noise(x * 170, y * 26 + x * 20, 93) + 0.6 * noise(x * 90 - y * 30, y * 15, 95)
    grass = y < top + 0.012 * blades
    shade = smooth(1.1 * np.clip((top - y) / 0.12, 0, 1) + 0.15 - 0.42 * blades)
    color = mix(linear("8f8a3c"), linear("18261a"), shade) * (0.43 + 0.52 * smooth(0.6 + blades))[:, None]
    for petals, salt, rare in (("f3efe2", 101, 0.45), ("e7b23a", 107, 0.48), ("b04a8c", 113, 0.46)):
        color[noise(x * 60, y * 78, salt) > rare] = 0.95 * linear(petals)
    inside = np.flatnonzero(low.ravel())[grass]
    canvas.color.reshape(-1, 3)[inside] = color[grass]


PINES = (  # x, foot, height, width, salt
    (-0.375, -0.26, 0.50, 0.20, 200), (-0.47, -0.27, 0.40, 0.19, 207), (-0.285, -0.28, 0.30, 0.14, 214),
    (0.445, -0.275, 0.33, 0.15, 221), (0.49, -0.29, 0.44, 0.19, 228), (0.37, -0.285, 0.17, 0.085, 235),
)  # fmt: skip


def _pines(canvas: _Canvas) -> None:
    for x, foot, height, width, salt in PINES:
        down, side = (foot + height - canvas.y) / height, (canvas.x - x) / (width / 2)
        near = (down > 0) & (down < 1) & (np.abs(side) < 1.3)
        down, side = (
            down[near],
            side[near] - 0.008 / width * np.sin(down[near] * 5 + salt),
        )  # no trunk is quite straight
        out, left = np.abs(side), np.sign(side)
        # whorls of branches that hang; those of one side are not those of the other
        uneven = 0.9 * noise(down * 9, left * 3.3 + salt, salt)
        whorl, within = np.divmod((down - 0.055 * out * (1 - 0.3 * down)) * (15 + salt % 4) + uneven + left * 0.25, 1)
        length = 1 + 0.55 * noise(whorl * 1.7, left * 5.1 + salt * 0.7, salt + 1)
        reach = down**0.85 * (0.30 + 0.70 * within**0.9) * length
        needles = fractal(canvas.x[near] * 90, canvas.y[near] * 150 + out * 40 * width, 3, salt + 3)
        tree = (out < reach * (1 + 0.75 * needles) - 0.02) | (out * width < 0.0035 + 0.004 * down)
        lit = smooth(0.55 * side + 0.9 * needles + 0.45 * (1 - within) - 0.10)
        color = mix(linear("0b1712"), linear("6b6a35"), 0.75 * lit) * (0.55 + 0.9 * lit[:, None])
        inside = np.flatnonzero(near.ravel())[tree]
        canvas.color.reshape(-1, 3)[inside] = color[tree]
