"""Compute rays and colours pixel by pixel: `nerf_core.geometry.cameras.Cameras.rays` without temporary arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import jit
from nerf_core.geometry.lens import FAR_OFF, NEWTON_STEPS, SINGULAR, newton_step

SMALL = 1e-13  # on the image plane: a smaller step of Newton's method is lost in float32 directions
_newton_step = jit(newton_step)


@jit
def rays(
    index: Any, pixels: Any, focal: Any, principal: Any, lens: Any, c2w: Any, near: Any, far: Any, first: Any,
    last: Any, origins: Any, directions: Any, nears: Any, fars: Any,
) -> None:  # fmt: skip
    """Write the rays first ≤ r < last through `pixels` of the cameras `index`."""
    for r in range(first, last):
        n = index[r]
        x0, y0 = (pixels[r, 0] - principal[n, 0]) / focal[n, 0], (pixels[r, 1] - principal[n, 1]) / focal[n, 1]
        x, y = x0, y0
        k1, k2, k3, p1, p2 = lens[n, 0], lens[n, 1], lens[n, 2], lens[n, 3], lens[n, 4]
        if k1 != 0 or k2 != 0 or k3 != 0 or p1 != 0 or p2 != 0:
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
        for a in range(3):
            origins[r, a] = c2w[n, a, 3]
            directions[r, a] = c2w[n, a, 0] * lx + c2w[n, a, 1] * ly + c2w[n, a, 2] * lz
        nears[r] = near * length
        fars[r] = far * length


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
