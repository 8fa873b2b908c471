"""Lenses: maps between directions from a camera and the points of its sensor, in units of the focal length.

There are three kinds. A *perspective* lens shows a direction where it meets the plane at depth 1, bent by OpenCV's
rational and tangential polynomials. A *fisheye* lens shows it at a distance from the centre that is a polynomial of the
angle θ to the optical axis. An *equirectangular* picture has longitude and latitude for its axes. The last two are
*wide*: they may see beside and behind the camera, where there is no such plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

PERSPECTIVE, FISHEYE, EQUIRECTANGULAR = 0, 1, 2
KINDS = ("perspective", "fisheye", "equirectangular")
NEWTON_STEPS = (
    10  # Newton's method converges quadratically: a lens that does not fold inside the image needs 3 to 5 steps
)
SINGULAR = 1e-9  # |det J| at a fold of the lens: there a distorted point has no unique ideal point
FAR_OFF = 1e9  # on the image plane: a result beyond this means that Newton's method diverged
SAME_PLACE = 1e-3  # on the image plane, or in radians: the tolerance of a round trip; a folded point misses by far more
BESIDE = 1e6  # on the image plane: points farther out count as beside the camera (a lens raises them to the 7th power)
ANGLE_STEPS = 40  # of θ; Newton's method needs some 5, and bisection, beyond the angle at which a lens folds, needs all
SMALL_ANGLE = 1e-13  # radians: a smaller step is lost in float32 directions


def newton_step(x: Any, y: Any, x0: Any, y0: Any, k1: Any, k2: Any, k3: Any, p1: Any, p2: Any) -> tuple[Any, Any, Any]:
    """Compute one step of Newton's method for `Lens.distort(x, y) = (x0, y0)`, where k4, k5 and k6 are 0.

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


def rational_step(
    x: Any, y: Any, x0: Any, y0: Any, k1: Any, k2: Any, k3: Any, p1: Any, p2: Any, k4: Any, k5: Any, k6: Any
) -> tuple[Any, Any, Any]:
    """Compute what `newton_step` does, for a lens with k4, k5 and k6."""
    r2 = x * x + y * y
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    slope = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / below
    ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x0
    ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y0
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return yy * ex - xy * ey, xx * ey - xy * ex, xx * yy - xy * xy


def fisheye_radius(t: Any, k1: Any, k2: Any, k3: Any, k4: Any) -> tuple[Any, Any]:
    """Return the distance from the centre at which a fisheye lens shows the angle t, and its derivative.

    θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) (OpenCV, calib3d, fisheye). It takes numbers or arrays, and numba
    compiles it too.
    """
    t2 = t * t
    radius = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    return radius, slope


def _any(value: Any) -> bool:
    """Whether a number, or any of an array, is not 0. np.any takes 4 µs for a number, and a frame asks 40 times."""
    return bool(value) if isinstance(value, int | float) else bool(np.any(value))


class Seen(NamedTuple):
    """Where a lens shows P points.

    bent: (P, 2) on the sensor, in units of the focal length, y down.
    depth: (P,) z-depth; for a wide lens the distance. At depth ≤ 0 a point lies behind the camera.
    shown: (P,) whether the lens shows the point there, and not something else.
    """

    bent: np.ndarray
    depth: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True)
class Lens:
    """A lens; all zeros is a pinhole.

    The coefficients and the kind are numbers, or arrays (P,) with one lens for each of P points. Points of the sensor
    and of the image plane are (P, 2) in units of the focal length, y down. The unit of a wide lens is the radian.

    k1, k2, k3, k4, k5, k6, p1, p2: of a perspective lens, see `distort`. A fisheye lens has k1 to k4, see
        `fisheye_radius`, and an equirectangular picture none.
    kind: PERSPECTIVE, FISHEYE or EQUIRECTANGULAR.
    """

    k1: Any = 0.0
    k2: Any = 0.0
    k3: Any = 0.0
    p1: Any = 0.0
    p2: Any = 0.0
    k4: Any = 0.0
    k5: Any = 0.0
    k6: Any = 0.0
    kind: Any = PERSPECTIVE

    @property
    def coefficients(self) -> tuple[Any, ...]:
        """k1, k2, k3, p1, p2, k4, k5, k6, kind."""
        return self.k1, self.k2, self.k3, self.p1, self.p2, self.k4, self.k5, self.k6, self.kind

    @property
    def bends(self) -> bool:
        """True for anything but a pinhole."""
        return any(_any(value) for value in self.coefficients)

    @property
    def wide(self) -> bool:
        """True if the lens, or any of several, is no perspective lens. Its depths are distances."""
        return _any(self.kind)

    @property
    def _rational(self) -> bool:
        return any(_any(value) for value in (self.k4, self.k5, self.k6))

    # ---- directions ----------------------------------------------------------------------------------------------

    def directions(self, bent: np.ndarray) -> np.ndarray:
        """Return the directions (P, 3) that the lens shows at points (P, 2) of the sensor, in the camera's axes.

        x points right, y up, and the camera looks along −z. A perspective lens has the vector (x, −y, −1) to the plane
        at depth 1, a wide one a unit vector. A fisheye lens shows nothing beyond the angle at which it folds; points
        there have that angle.
        """
        if not self.wide:
            plane = self.undistort(bent) if self.bends else bent
            return np.stack([plane[..., 0], -plane[..., 1], -np.ones_like(plane[..., 0])], -1)
        found = np.empty((len(bent), 3))
        for part, lens in self._kinds(len(bent)):
            found[part] = lens._wide_directions(bent[part]) if lens.kind else lens.directions(bent[part])
        return found

    def see(self, local: np.ndarray) -> Seen:
        """Return where the lens shows points (P, 3), which are given in the camera's axes: the inverse of `directions`.

        Far outside the picture the polynomial may turn back. It then maps points into the picture although the lens
        shows something else there.
        """
        if not self.wide:
            return self._on_plane(local)
        found = Seen(np.empty((len(local), 2)), np.empty(len(local)), np.empty(len(local), bool))
        for part, lens in self._kinds(len(local)):
            done = lens._around(local[part]) if lens.kind else lens._on_plane(local[part])
            for whole, piece in zip(found, done, strict=True):
                whole[part] = piece
        return found

    def _kinds(self, count: int) -> list[tuple[Any, Lens]]:
        """Return which of `count` points have a lens of each kind, and the lenses of these points, with one kind."""
        kinds = np.unique(self.kind).astype(int).tolist()
        if len(kinds) == 1:
            return [(slice(None), Lens(*self.coefficients[:-1], kind=kinds[0]))]
        columns = [np.broadcast_to(value, count) for value in self.coefficients]
        parts = [columns[-1] == kind for kind in kinds]
        return [
            (part, Lens(*(column[part] for column in columns[:-1]), kind=kind))
            for part, kind in zip(parts, kinds, strict=True)
        ]

    # ---- perspective ---------------------------------------------------------------------------------------------

    def _on_plane(self, local: np.ndarray) -> Seen:
        depth = -local[:, 2]
        # a point in the camera's plane has no pixel; its depth says so
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        plane = np.stack([local[:, 0], -local[:, 1]], -1) / safe[:, None]
        if not self.bends:
            return Seen(plane, depth, np.ones(len(plane), bool))
        plane = np.clip(plane, -BESIDE, BESIDE)
        bent = self.distort(plane)
        return Seen(bent, depth, self.shows(plane, bent))

    def distort(self, plane: np.ndarray) -> np.ndarray:
        """Map ideal points (P, 2) to the points (P, 2) where a perspective lens shows them.

        With r² = x² + y²: x′ = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²).
        y′ is the same with x and y, and p1 and p2, exchanged (OpenCV, calib3d).
        """
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        if self._rational:
            with np.errstate(divide="ignore", invalid="ignore"):  # far outside the picture; `shows` says so
                radial = radial / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
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
        rational = self._rational
        plain, every = self.coefficients[:5], self.coefficients[:8]
        # absurd coefficients overflow, or divide by zero; the last lines catch that
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(NEWTON_STEPS):
                step = rational_step(x, y, x0, y0, *every) if rational else newton_step(x, y, x0, y0, *plain)
                mx, my, det = step
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

    # ---- wide lenses ---------------------------------------------------------------------------------------------

    def _wide_directions(self, bent: np.ndarray) -> np.ndarray:
        x, y = bent[:, 0], bent[:, 1]
        if self.kind == EQUIRECTANGULAR:
            return np.stack([np.sin(x) * np.cos(y), -np.sin(y), -np.cos(x) * np.cos(y)], -1)
        radius = np.hypot(x, y)
        angle = self.angle(radius)
        scale = np.where(radius > 0, np.sin(angle) / np.where(radius > 0, radius, 1.0), 1.0)
        return np.stack([x * scale, -y * scale, -np.cos(angle)], -1)

    def _around(self, local: np.ndarray) -> Seen:
        x, y, z = local[:, 0], -local[:, 1], -local[:, 2]
        depth = np.sqrt((local * local).sum(-1))
        if self.kind == EQUIRECTANGULAR:
            bent = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], -1)
            return Seen(bent, depth, depth > 0)
        aside = np.hypot(x, y)
        angle = np.arctan2(aside, z)
        with np.errstate(over="ignore", invalid="ignore"):  # absurd coefficients
            radius, _ = fisheye_radius(angle, self.k1, self.k2, self.k3, self.k4)
            scale = radius / np.where(aside > 0, aside, 1.0)
            shown = (np.abs(self.angle(radius) - angle) < SAME_PLACE) & (depth > 0)
        return Seen(np.stack([x * scale, y * scale], -1), depth, shown)

    def reach(self) -> float:
        """Return how far from the centre one fisheye lens shows something; infinite for other lenses."""
        if self.kind != FISHEYE:
            return float("inf")
        edge = self.angle(np.array([FAR_OFF]))
        return float(fisheye_radius(edge, self.k1, self.k2, self.k3, self.k4)[0][0])

    def angle(self, radius: np.ndarray) -> np.ndarray:
        """Return the angles θ (P,) that a fisheye lens shows at distances (P,) from the centre: 0 to π.

        It inverts `fisheye_radius` up to its first fold with Newton's method, and with bisection where that leaves the
        bracket or the polynomial falls. Beyond the fold it returns the angle of the fold.
        """
        low, high = np.zeros_like(radius), np.full_like(radius, np.pi)
        t = np.clip(radius, 0.0, np.pi)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(ANGLE_STEPS):
                value, slope = fisheye_radius(t, self.k1, self.k2, self.k3, self.k4)
                below = (value < radius) & (slope > 0)
                low, high = np.where(below, t, low), np.where(below, high, t)
                moved = t - (value - radius) / slope
                moved = np.where((slope > 0) & (moved >= low) & (moved <= high), moved, 0.5 * (low + high))
                done = np.abs(moved - t).max(initial=0.0) < SMALL_ANGLE
                t = moved
                if done:
                    break
        return t


PINHOLE = Lens()
