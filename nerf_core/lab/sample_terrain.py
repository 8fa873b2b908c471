"""The mountains of the sample photo: a height field with rock, snow and forest, seen in perspective.

World coordinates: x to the right, z into the picture, heights above the lake. Heights and distances have one unit.
"""

from __future__ import annotations

import numpy as np

from nerf_core.lab.sample_noise import TURN, Array, F, fractal, linear, mix, noise_slope, smooth, turned

EYE = 0.16  # the camera's height above the lake
FOCAL = 1.62  # focal length in heights of the picture
SHORE, FARTHEST = 9.3, 30.0  # the distances between which there is land
SUN = np.array([0.86, 0.36, -0.22], F) / F(np.linalg.norm([0.86, 0.36, -0.22]))  # towards it: low on the right
SUNLIGHT = np.array([2.9, 2.03, 1.276], F)
SKYLIGHT = np.array([0.211, 0.285, 0.471], F)
HAZE = 0.95 * linear("b9c4dc")
# Peaks and, behind the shore, hills: x, z, height, width. Noise adds to the heights and takes from them.
PEAKS = (
    (-1.7, 15.0, 9.3, 2.5), (2.6, 16.5, 7.2, 2.4), (-5.4, 17.0, 4.8, 2.6), (5.9, 19.0, 5.8, 2.8), (0.5, 23.0, 7.1, 3.0),
    (-8.5, 24.0, 6.3, 4.0), (9.5, 25.0, 6.5, 4.0), (-3.9, 12.2, 1.5, 2.0), (4.9, 12.4, 1.7, 2.2), (0.6, 11.8, 0.9, 1.6),
)  # fmt: skip
MARCH_OCTAVES = 6  # finer ones are too small to hide anything behind them; they only tilt the surface
STEPS = 460  # depths at which a column's heights are computed, each 0.25 % farther away
SLOPE_STEP = 0.02  # of the difference quotient of the smooth envelope; its features are a hundred times as large


def distances(n: int, horizon: float) -> Array:
    """Return the distance z (n, n) of the land behind each pixel; inf where there is none.

    For every column of pixels the height field is projected from the front to the back. A pixel shows the first depth
    at which the land reaches its row.

    Args:
        n: pixels of each side.
        horizon: its row from the top, as a share of the picture.
    """
    across = pixel_directions(n)
    z = (SHORE * (FARTHEST / SHORE) ** (np.arange(STEPS) / (STEPS - 1))).astype(F)
    height = ground(across[None] * z[:, None], np.broadcast_to(z[:, None], (STEPS, n)), MARCH_OCTAVES)[0]
    row = n * (horizon - FOCAL * (height - EYE) / z[:, None])
    row[0] = n * (horizon + FOCAL * EYE / SHORE)
    reached = np.minimum.accumulate(row, 0)
    rows, found = np.arange(n) + 0.5, np.full((n, n), np.inf, F)
    for column in range(n):
        step = np.searchsorted(-reached[:, column], -rows)
        seen = (step > 0) & (step < STEPS)
        k = step[seen]
        above, below = row[k, column], row[k - 1, column]
        share = np.clip((below - rows[seen]) / np.maximum(below - above, 1e-9), 0, 1)  # level land has no rows
        found[seen, column] = z[k - 1] + (z[k] - z[k - 1]) * share
    return found


def pixel_directions(n: int) -> Array:
    """Return x / z (n,) of each column of pixels."""
    return ((np.arange(n) + 0.5) / n - 0.5).astype(F) / F(FOCAL)


def _envelope(x: Array, z: Array) -> Array:
    """Return the heights of the mountains without their detail."""
    total = np.zeros(x.shape, F)
    for peak_x, peak_z, height, width in PEAKS:
        squared = ((x - F(peak_x)) / F(width)) ** 2 + ((z - F(peak_z)) * F(0.85 / width)) ** 2
        total += (F(height) * np.exp(F(-1.25) * np.sqrt(squared + F(0.18)))) ** 3
    return np.cbrt(total) * smooth((z - F(9.2)) * F(1 / 1.6))


def ground(x: Array, z: Array, octaves: int) -> tuple[Array, Array, Array]:
    """Return the height of the land and its slopes along x and z.

    Octaves of ridges, 1 − 1.9 |noise|, are added up. An octave counts less where the coarser ones are steep, as if
    water had washed the slopes smooth.
    """
    u, v = F(0.4) * x + F(3.1), F(0.4) * z + F(1.7)
    ridges, slope_x, slope_z, steep_x, steep_z = (np.zeros(x.shape, F) for _ in range(5))
    strength, turn = 1.0, 0.4 * np.eye(2)
    for octave in range(octaves):
        n, du, dv = noise_slope(u, v, 11 + octave)
        rounded = np.sqrt(n * n + F(0.0012))  # |n| with a blunt tip
        to_x = F(-1.9) * n / rounded * (du * F(turn[0, 0]) + dv * F(turn[1, 0]))
        to_z = F(-1.9) * n / rounded * (du * F(turn[0, 1]) + dv * F(turn[1, 1]))
        steep_x += F(0.8 * strength) * to_x
        steep_z += F(0.8 * strength) * to_z
        share = F(strength) / (1 + F(0.55) * (steep_x**2 + steep_z**2))
        ridges += share * (1 - F(1.9) * rounded)
        slope_x += share * to_x
        slope_z += share * to_z
        u, v = turned(u, v)
        turn, strength = TURN @ turn, 0.41 * strength
    coarse, shape = _envelope(x, z), F(0.34) + F(0.46) * ridges
    d = F(SLOPE_STEP)
    coarse_x, coarse_z = (_envelope(x + d, z) - coarse) / d, (_envelope(x, z + d) - coarse) / d
    fine = F(0.46) * coarse
    return coarse * shape - F(0.06), coarse_x * shape + fine * slope_x, coarse_z * shape + fine * slope_z


def shaded(x: Array, z: Array, octaves: int) -> Array:
    """Return the linear colours (P, 3) that the land shows the camera at x, z (P,)."""
    height, *slopes = ground(x, z, octaves)
    normal, broad = _normals(*slopes), _normals(*ground(x, z, 3)[1:])
    # whole flanks that face away from the sun lie in shadow, whatever their rocks do
    sun = np.maximum(normal @ SUN, 0) ** 0.9 * smooth((broad @ SUN + 0.02) / 0.36)
    sky = 0.5 + 0.5 * normal[:, 1]
    color = _materials(x, z, height, normal[:, 1]) * (sun[:, None] * SUNLIGHT + sky[:, None] * SKYLIGHT)
    haze = (1 - np.exp(-np.maximum(z - 9, 0) / 30)) * (0.35 + 0.65 * np.exp(-np.maximum(height, 0)))
    return mix(color, HAZE, haze).astype(F)


def _normals(slope_x: Array, slope_z: Array) -> Array:
    """Return unit normals (P, 3) of slopes (P,)."""
    up = np.stack([-slope_x, np.ones_like(slope_x), -slope_z], -1)
    return up / np.linalg.norm(up, axis=-1, keepdims=True)


def _materials(x: Array, z: Array, height: Array, level: Array) -> Array:
    """Return albedos (P, 3): rock, snow where it is high and level, forest and meadows below; level is normal y."""
    patches, grain = fractal(x * 3.5, height * 9 + z * 2, 4, 31), fractal(x * 16, z * 16, 4, 41)
    rock = mix(linear("5c5048"), linear("9a826b"), smooth(0.5 + 0.9 * patches)) * (1 + 0.35 * grain[:, None])
    clings = smooth((level - 0.53 + 0.12 * grain + 0.05 * np.clip(height - 1.6, 0, 2.2)) / 0.16)
    color = mix(rock, np.array([0.90, 0.93, 0.98], F), clings * smooth((height - 1.15 + 0.5 * patches) / 0.5))

    crowns, stands = fractal(x * 30, z * 30 + height * 26, 3, 51), fractal(x * 1.3, z * 1.3, 3, 59)
    forest = mix(linear("0e1b17"), linear("55602f"), smooth(0.36 + 0.75 * crowns + 0.9 * stands))
    forest = mix(forest, linear("8a6a2c"), 0.6 * smooth((0.5 * crowns + 1.3 * stands - 0.26) / 0.25))  # larches
    meadow = mix(linear("6d7434"), linear("93843f"), smooth(0.5 + patches))
    clearing = smooth((fractal(x * 1.6 + 9, z * 0.8 + height * 2, 4, 57) + 0.25 * grain - 0.22) / 0.06)
    forest = mix(forest, meadow, 0.8 * clearing * smooth((0.55 - height) / 0.15))
    return mix(color, forest, smooth((1.15 - height + 0.5 * patches) / 0.3) * smooth((level - 0.25) / 0.2))
