"""The solids of the demo scene: signed distance, normal and first hit of a sphere, capsule, torus, rounded cylinder.

Spheres are intersected in closed form. The others have exact signed distances and are sphere-traced (Hart, "Sphere
tracing", 1996) inside their bounding sphere until the distance is under 1e-9; their normals are the distance's
analytic gradient. Points P and rays R; everything float64; directions are unit vectors; t is inf where nothing is hit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLERANCE = 1e-9  # the distance to the surface at which a ray has arrived
MAX_STEPS = 512  # only rays that graze within about 1e-6 of a surface need more: they count as misses


def dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def sphere_interval(origins: Array, directions: Array, centre: Array, radius: float) -> tuple[Array, Array]:
    """Where rays (R, 3) enter and leave a sphere: t (R,), (R,); both NaN for rays that miss it."""
    offset = centre - origins
    middle = dot(offset, directions)
    # |offset − middle · d|² instead of |offset|² − middle²: no cancellation far from the sphere
    half2 = radius**2 - ((offset - middle[:, None] * directions) ** 2).sum(-1)
    half = np.sqrt(np.where(half2 >= 0, half2, np.nan))
    return middle - half, middle + half


class Shape(ABC):
    """A solid with an exact signed distance (negative inside).

    bound: radius of its bounding sphere around `centre`. width: half of how wide it looks at its narrowest.
    """

    def __init__(self, centre: Array, bound: float, width: float) -> None:
        self.centre, self.bound, self.width = centre, bound, width

    @abstractmethod
    def distance(self, points: Array) -> Array:
        """Signed distance of points (P, 3) → (P,)."""

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Outward unit normals at surface points (P, 3) → (P, 3)."""

    def hit(self, origins: Array, directions: Array) -> Array:
        """First t > 0 (R,) at which rays from outside meet the surface; inf for misses."""
        enter, leave = sphere_interval(origins, directions, self.centre, self.bound)
        result = np.full(len(origins), np.inf)
        active = np.flatnonzero(leave > 0)
        t = np.maximum(enter[active], 0.0)
        for _ in range(MAX_STEPS):
            gap = self.distance(origins[active] + t[:, None] * directions[active])
            arrived = gap < TOLERANCE
            result[active[arrived]] = t[arrived]
            t = t + gap
            going = ~arrived & (t < leave[active])
            active, t = active[going], t[going]
            if not len(active):
                break
        return result


class Sphere(Shape):
    def __init__(self, centre: Array, radius: float) -> None:
        super().__init__(centre, radius, radius)

    def distance(self, points: Array) -> Array:
        return np.linalg.norm(points - self.centre, axis=-1) - self.bound

    def normal(self, points: Array) -> Array:
        return unit(points - self.centre)

    def hit(self, origins: Array, directions: Array) -> Array:
        near, _ = sphere_interval(origins, directions, self.centre, self.bound)
        return np.where(near > 0, near, np.inf)


class Capsule(Shape):
    """All points within `radius` of the segment from `start` to `end`."""

    def __init__(self, start: Array, end: Array, radius: float) -> None:
        self.start, self.axis = start, end - start
        super().__init__((start + end) / 2, float(np.linalg.norm(self.axis)) / 2 + radius, radius)

    def _from_axis(self, points: Array) -> Array:
        along = np.clip((points - self.start) @ self.axis / (self.axis @ self.axis), 0, 1)
        return points - self.start - along[:, None] * self.axis

    def distance(self, points: Array) -> Array:
        return np.linalg.norm(self._from_axis(points), axis=-1) - self.width

    def normal(self, points: Array) -> Array:
        return unit(self._from_axis(points))


class Torus(Shape):
    """A ring of radius `major` around the unit `axis`, of wire with radius `minor`."""

    def __init__(self, centre: Array, axis: Array, major: float, minor: float) -> None:
        super().__init__(centre, major + minor, minor)
        self.axis, self.major = axis, major

    def _from_wire(self, points: Array) -> Array:
        offset = points - self.centre
        height = (offset @ self.axis)[:, None] * self.axis
        flat = offset - height
        radius = np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-12)  # on the axis: as far from all wire
        return height + flat * (1 - self.major / radius)

    def distance(self, points: Array) -> Array:
        return np.linalg.norm(self._from_wire(points), axis=-1) - self.width

    def normal(self, points: Array) -> Array:
        return unit(self._from_wire(points))


class RoundedCylinder(Shape):
    """An upright cylinder from z = centre − half to centre + half, its edges rounded by `bevel`."""

    def __init__(self, centre: Array, radius: float, half: float, bevel: float) -> None:
        super().__init__(centre, float(np.hypot(radius, half)), min(radius, half))
        self.radius, self.half, self.bevel = radius, half, bevel

    def _beyond_core(self, offset: Array) -> tuple[Array, Array]:
        """How far offsets (P, 3) from the centre lie outside the bevel's core, sideways (P,) and vertically (P,)."""
        side = np.hypot(offset[:, 0], offset[:, 1]) - (self.radius - self.bevel)
        return side, np.abs(offset[:, 2]) - (self.half - self.bevel)

    def distance(self, points: Array) -> Array:
        side, up = self._beyond_core(points - self.centre)
        return np.hypot(np.maximum(side, 0), np.maximum(up, 0)) + np.minimum(np.maximum(side, up), 0) - self.bevel

    def normal(self, points: Array) -> Array:
        offset = points - self.centre
        side, up = self._beyond_core(offset)
        # on the axis the sideways part is zero, whatever the divisor
        sideways = np.maximum(side, 0) / np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
        upwards = np.maximum(up, 0) * np.sign(offset[:, 2])
        return unit(np.stack([offset[:, 0] * sideways, offset[:, 1] * sideways, upwards], -1))
