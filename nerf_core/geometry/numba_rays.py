"""Compute rays and colours pixel by pixel: `nerf_core.geometry.cameras.Cameras.rays` without temporary arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import jit
from nerf_core.geometry.lens import (
    ANGLE_STEPS,
    EQUIRECTANGULAR,
    FAR_OFF,
    NEWTON_STEPS,
    SINGULAR,
    SMALL_ANGLE,
    fisheye_radius,
    newton_step,
    rational_step,
)

SMALL = 1e-13  # on the image plane: a smaller step of Newton's method is lost in float32 directions
_newton_step = jit(newton_step)
_rational_step = jit(rational_step)
_fisheye_radius = jit(fisheye_radius)


@jit
def rays(
    index: Any, pixels: Any, focal: Any, principal: Any, lens: Any, c2w: Any, near: Any, far: Any, first: Any,
    last: Any, origins: Any, directions: Any, nears: Any, fars: Any,
) -> None:  # fmt: skip
    """Write the rays first ≤ r < last through `pixels` of the cameras `index`."""
    for r in range(first, last):
        n = index[r]
        x0, y0 = (pixels[r, 0] - principal[n, 0]) / focal[n, 0], (pixels[r, 1] - principal[n, 1]) / focal[n, 1]
        if lens[n, 8] != 0:
            lx, ly, lz = _wide_direction(x0, y0, lens, n)
            nears[r], fars[r] = near, far
        else:
            x, y = x0, y0
            k1, k2, k3, p1, p2 = lens[n, 0], lens[n, 1], lens[n, 2], lens[n, 3], lens[n, 4]
            if lens[n, 5] != 0 or lens[n, 6] != 0 or lens[n, 7] != 0:
                x, y = _rational(x0, y0, lens, n)
            elif k1 != 0 or k2 != 0 or k3 != 0 or p1 != 0 or p2 != 0:
                for _ in range(NEWTON_STEPS):
                    mx, my, det = _newton_step(x, y, x0, y0, k1, k2, k3, p1, p2)
                    if abs(det) <= SINGULAR:
                        break
                    mx, my = mx / det, my / det
                    x -= mx
                    y -= my
                    if abs(mx) + abs(my) < SMALL:
                        break
                if not abs(x) + abs(y) < FAR_OFF:
                    x, y = x0, y0
            length = math.sqrt(x * x + y * y + 1)
            lx, ly, lz = x / length, -y / length, -1 / length
            nears[r] = near * length
            fars[r] = far * length
        for a in range(3):
            origins[r, a] = c2w[n, a, 3]
            directions[r, a] = c2w[n, a, 0] * lx + c2w[n, a, 1] * ly + c2w[n, a, 2] * lz


@jit
def _rational(x0: Any, y0: Any, lens: Any, n: Any) -> Any:
    """Undo a perspective lens with k4, k5 or k6, as `Lens.undistort` does."""
    x, y = x0, y0
    for _ in range(NEWTON_STEPS):
        mx, my, det = _rational_step(
            x, y, x0, y0, lens[n, 0], lens[n, 1], lens[n, 2], lens[n, 3], lens[n, 4], lens[n, 5], lens[n, 6], lens[n, 7]
        )
        if abs(det) <= SINGULAR:
            break
        mx, my = mx / det, my / det
        x -= mx
        y -= my
        if abs(mx) + abs(my) < SMALL:
            break
    if not abs(x) + abs(y) < FAR_OFF:
        x, y = x0, y0
    return x, y


@jit
def _wide_direction(x: Any, y: Any, lens: Any, n: Any) -> Any:
    """Return the unit direction that a wide lens shows at a point of the sensor, as `Lens.directions` does."""
    if lens[n, 8] == EQUIRECTANGULAR:
        return math.sin(x) * math.cos(y), -math.sin(y), -math.cos(x) * math.cos(y)
    radius = math.sqrt(x * x + y * y)
    low, high = 0.0, math.pi
    t = min(radius, math.pi)
    for _ in range(ANGLE_STEPS):
        value, slope = _fisheye_radius(t, lens[n, 0], lens[n, 1], lens[n, 2], lens[n, 5])
        if value < radius and slope > 0:
            low = t
        else:
            high = t
        moved = t - (value - radius) / slope
        if not (slope > 0 and low <= moved <= high):
            moved = 0.5 * (low + high)
        step = abs(moved - t)
        t = moved
        if step < SMALL_ANGLE:
            break
    scale = math.sin(t) / radius if radius > 0 else 1.0
    return x * scale, -y * scale, -math.cos(t)


@jit
def colors(
    index: Any, pixels: Any, widths: Any, starts: Any, flat: Any, scale: Any, first: Any, last: Any, found: Any
) -> None:
    """Write the colours of integer `pixels`. Photo n begins at starts[n] of `flat` (P, 3); 1 is 65535 / `scale`."""
    for r in range(first, last):
        n = index[r]
        at = starts[n] + pixels[r, 1] * widths[n] + pixels[r, 0]
        for c in range(3):
            found[r, c] = np.float32(scale * flat[at, c]) / np.float32(65535)
