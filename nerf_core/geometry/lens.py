"""Lens distortion: maps between ideal pinhole points on the image plane and the points where a lens shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

NEWTON_STEPS = (
    10  # Newton's method converges quadratically: a lens that does not fold inside the image needs 3 to 5 steps
)
SINGULAR = 1e-9  # |det J| at a fold of the lens: there a distorted point has no unique ideal point
FAR_OFF = 1e9  # on the image plane: a result beyond this means that Newton's method diverged
SAME_PLACE = 1e-3  # on the image plane: the tolerance of a round trip; a folded point misses by far more


def newton_step(x: Any, y: Any, x0: Any, y0: Any, k1: Any, k2: Any, k3: Any, p1: Any, p2: Any) -> tuple[Any, Any, Any]:
    """Compute one step of Newton's method for `Lens.distort(x, y) = (x0, y0)`.

    It takes numbers or arrays, and numba compiles it too.

    Returns:
        mx, my, det: the step is x −= mx / det, y −= my / det. The caller does not move a point whose |det| ≤ SINGULAR.
    """
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r²
    ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x0
    ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y0
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return yy * ex - xy * ey, xx * ey - xy * ex, xx * yy - xy * xy


@dataclass(frozen=True)
class Lens:
    """OpenCV's radial-tangential lens; all zeros is a pinhole.

    k1, k2, k3, p1, p2: numbers, or arrays (P,) with one lens for each of P points.
    Image-plane points are (P, 2) in units of the focal length, y down.
    """

    k1: Any = 0.0
    k2: Any = 0.0
    k3: Any = 0.0
    p1: Any = 0.0
    p2: Any = 0.0

    @property
    def coefficients(self) -> tuple[Any, ...]:
        """k1, k2, k3, p1, p2."""
        return self.k1, self.k2, self.k3, self.p1, self.p2

    @property
    def bends(self) -> bool:
        """True if any coefficient is not zero."""
        return any(np.any(value) for value in self.coefficients)

    def distort(self, plane: np.ndarray) -> np.ndarray:
        """Map ideal points (P, 2) to the points (P, 2) where the lens shows them.

        With r² = x² + y²: x′ = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²). y′ is the same with x and y,
        and p1 and p2, exchanged (OpenCV, calib3d).
        """
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        bent_x = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        bent_y = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([bent_x, bent_y], -1)

    def undistort(self, bent: np.ndarray) -> np.ndarray:
        """Invert `distort` with Newton's method: (P, 2) → (P, 2).

        A point where the Jacobian is singular (beyond the fold of an absurd calibration) is not moved. A point for
        which the method diverges is returned as given.
        """
        x0, y0 = bent[..., 0], bent[..., 1]
        x, y = x0, y0
        with np.errstate(over="ignore", invalid="ignore"):  # absurd coefficients overflow; the last lines catch that
            for _ in range(NEWTON_STEPS):
                mx, my, det = newton_step(x, y, x0, y0, *self.coefficients)
                regular = np.abs(det) > SINGULAR
                inverse = np.where(regular, 1 / np.where(regular, det, 1.0), 0.0)
                x, y = x - mx * inverse, y - my * inverse
            found = np.abs(x) + np.abs(y) < FAR_OFF  # false for NaN as well
        return np.stack([np.where(found, x, x0), np.where(found, y, y0)], -1)

    def shows(self, plane: np.ndarray, bent: np.ndarray) -> np.ndarray:
        """Return which ideal points (P, 2) are really seen at their distorted points `bent` (P, 2), as bool (P,).

        Far outside the picture the polynomial may turn back. It then maps points into the picture although the lens
        shows something else there.
        """
        return np.abs(self.undistort(bent) - plane).max(-1) < SAME_PLACE


PINHOLE = Lens()
