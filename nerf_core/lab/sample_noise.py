"""Noise, colours and blends that the sample photo is drawn with: numpy alone, and no random generator.

Noise is a function of the place, made from hashed lattice points, so that the picture is the same every time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray  # of float32, in which the noise takes half the time
F = np.float32

_ANGLES = 0.2 + np.arange(16) * (np.pi / 8)  # of the gradients at lattice points; 0.2 keeps them off the axes
_GRADIENTS = np.cos(_ANGLES).astype(F), np.sin(_ANGLES).astype(F)
# From one octave to the next the plane is turned by 37° and scaled by 2, so that lattices do not line up.
TURN = np.array([[1.6, -1.2], [1.2, 1.6]])
SHIFT = (0.37, -0.71)


def noise(x: Array, y: Array, salt: int) -> Array:
    """Return Perlin's gradient noise at (x, y), of any equal shapes: about −0.7 to 0.7, with features of size 1.

    Another `salt` gives another pattern.
    """
    return _corners(x, y, salt)[0]


def noise_slope(x: Array, y: Array, salt: int) -> tuple[Array, Array, Array]:
    """Return `noise` and its derivatives along x and y."""
    n, (gx, gy), (u, v), (fx, fy), (ab, ac, abcd) = _corners(x, y, salt)
    du, dv = 30 * (fx * (fx - 1)) ** 2, 30 * (fy * (fy - 1)) ** 2
    slope = [g[0] + u * (g[1] - g[0]) + v * (g[2] - g[0]) + u * v * (g[0] - g[1] - g[2] + g[3]) for g in (gx, gy)]
    return n, slope[0] + du * (ab + v * abcd), slope[1] + dv * (ac + u * abcd)


def _corners(x: Array, y: Array, salt: int) -> tuple[Any, ...]:
    """Return noise; the gradients of the four corners; blend weights; places in the cell; differences of corners."""
    column, row = np.floor(x), np.floor(y)
    fx, fy = x - column, y - row
    i, j = (v.astype(np.int32).astype(np.uint32) for v in (column, row))
    one = np.uint32(1)
    at = [_hashed(i + a * one, j + b * one, salt) >> np.uint32(28) for b in (0, 1) for a in (0, 1)]
    gx, gy = ([table[k] for k in at] for table in _GRADIENTS)
    a, b, c, d = (gx[k] * (fx - k % 2) + gy[k] * (fy - k // 2) for k in range(4))
    u, v = (f * f * f * (f * (6 * f - 15) + 10) for f in (fx, fy))
    ab, ac, abcd = b - a, c - a, a - b - c + d
    return a + u * ab + v * ac + u * v * abcd, (gx, gy), (u, v), (fx, fy), (ab, ac, abcd)


def _hashed(i: np.ndarray, j: np.ndarray, salt: int) -> np.ndarray:
    """Return 32 hashed bits for integer places (a murmur3 finaliser); they are the same on every machine."""
    h = i * np.uint32(0x8DA6B343) + j * np.uint32(0xD8163841) + np.uint32(salt * 0x9E3779B1 & 0xFFFFFFFF)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    return h ^ (h >> np.uint32(16))


def fractal(x: Array, y: Array, octaves: int, salt: int, gain: float = 0.5) -> Array:
    """Return octaves of noise added up. Each is twice as fine as the one before, and `gain` times as strong."""
    x, y = np.asarray(x, F), np.asarray(y, F)
    total, strength = np.zeros(np.broadcast_shapes(x.shape, y.shape), F), 1.0
    for octave in range(octaves):
        total += F(strength) * noise(x, y, salt + octave)
        x, y = turned(x, y)
        strength *= gain
    return total


def turned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the coordinates of the next octave."""
    return F(TURN[0, 0]) * x + F(TURN[0, 1]) * y + F(SHIFT[0]), F(TURN[1, 0]) * x + F(TURN[1, 1]) * y + F(SHIFT[1])


def smooth(x: Any) -> Any:
    """Return 0 below 0, 1 above 1, and 3x² − 2x³ between."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def mix(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return colours between a and b (…, 3), at shares (…) of b."""
    return a + (b - a) * share[..., None]


def linear(color: str) -> Array:
    """Return linear RGB (3,) of a hexadecimal sRGB colour (IEC 61966-2-1)."""
    encoded = np.array(list(bytes.fromhex(color))) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(F)
