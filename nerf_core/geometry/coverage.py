"""The space that training rays cross, and where the rays of a free camera begin and end.

`near` and `far` belong to the cameras of the capture: no photo shows what lies outside them. A free camera may stand
anywhere, also within the content. Its rays begin at its eye, or where they enter covered space if the eye stands
outside. What a model holds in space that no training ray crosses is arbitrary, so it is not drawn there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerf_core.geometry.camera import Camera

CELLS = 24  # cells a side of the cube: a training view of 0.7 radians is then about ten cells wide
STEPS = 64  # samples along a ray within the cube: its diagonal has 42 cells, so each step is shorter than a cell
MOST_VIEWS = 128  # views that fill the cells, spread evenly: 128 take about 30 ms


@dataclass(frozen=True)
class Coverage:
    """Which cells of a cube lie in a training view at a depth between near and far, and in none before near.

    low: (3,) the cube's lower corner, in world units.
    side: the side of a cell, in world units.
    covered: (CELLS, CELLS, CELLS) bool. Cells beside covered ones count too, so that no ray passes between two samples.
        Cells before the near bound of a photo that looks at them do not count, whatever other photos show: its rays
        pass them unseen, so that a model may hold fog there, and the bound says that they are empty.
    """

    low: np.ndarray
    side: float
    covered: np.ndarray

    @staticmethod
    def of(cameras: Sequence[Camera], near: float, far: float, center: np.ndarray, radius: float) -> Coverage:
        """Fill the cells from the training cameras.

        Args:
            cameras: the cameras of the training views. At most MOST_VIEWS of them are used.
            near, far: z-depths that enclose the content, in world units; for a wide lens, distances.
            center, radius: the centre (3,) and radius of the content. The cube also encloses all the cameras.
        """
        index = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), MOST_VIEWS)).round().astype(int))
        poses = np.array([camera.c2w for camera in cameras], dtype=np.float64).reshape(-1, 3, 4)
        half = max([float(radius), *np.abs(poses[:, :, 3] - center).max(1).tolist()]) * 1.01
        side = 2 * half / CELLS
        low = np.asarray(center, np.float64) - half
        centres = (low + (np.indices((CELLS,) * 3).reshape(3, -1).T + 0.5) * side).astype(np.float32)
        covered, empty = np.zeros(len(centres), bool), np.zeros(len(centres), bool)
        margin = side * 3**0.5 / 2  # a cell's corners lie this far from its centre
        for i in index:
            if cameras[i].lens.wide:
                covered |= _seen(cameras[i], centres, near, far)
                empty |= _seen(cameras[i], centres, 0.0, near - margin)
                continue
            left, right, bottom, top = _window(cameras[i])
            c2w = poses[i].astype(np.float32)
            x, y, z = ((centres - c2w[:, 3]) @ c2w[:, :3]).T
            framed = (x >= -left * z) & (x <= -right * z) & (y >= -bottom * z) & (y <= -top * z)
            covered |= framed & (-z >= near) & (-z <= far)
            beside = (x >= -left * z - margin) & (x <= -right * z + margin)
            beside &= (y >= -bottom * z - margin) & (y <= -top * z + margin)
            empty |= beside & (-z > -margin) & (-z < near - margin)
        return Coverage(low, side, _grown(covered.reshape((CELLS,) * 3)) & ~empty.reshape((CELLS,) * 3))

    def cells(self) -> tuple[np.ndarray, float]:
        """Return the centres (N, 3) of covered cells, and the radius of a ball around such a cell, in world units."""
        return self.low + (np.argwhere(self.covered) + 0.5) * self.side, 3**0.5 / 2 * self.side

    def encloses(self, point: np.ndarray) -> bool:
        """Return whether a point (3,) lies in the cube."""
        return bool(((point >= self.low) & (point <= self.low + CELLS * self.side)).all())

    def crossed(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where rays from one point cross covered cells.

        Args:
            origin: (3,) in world units.
            directions: (R, 3) of unit length.

        Returns:
            The distances (R,) at which they first enter and last leave covered cells; entry is 0 if the origin lies in
            one. Both are NaN for a ray that crosses none. And the distance (R,) at which they leave the cube, NaN for a
            ray beside it.
        """
        with np.errstate(divide="ignore"):
            inverse = 1 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        ends = np.stack([self.low - origin, self.low + CELLS * self.side - origin])[:, None] * inverse
        enter, leave = np.maximum(ends.min(0).max(-1), 0), ends.max(0).min(-1)
        beside = leave <= enter
        width = np.where(beside, 0, leave - enter) / (STEPS - 1)
        t = enter[:, None] + width[:, None] * np.arange(STEPS)
        cell = (origin - self.low + t[..., None] * directions[:, None]) / self.side
        inside = np.clip(cell, 0, CELLS - 1).astype(np.intp)
        hit = self.covered[inside[..., 0], inside[..., 1], inside[..., 2]] & ~beside[:, None]
        some, rows = hit.any(-1), np.arange(len(t))
        first, last = hit.argmax(-1), STEPS - 1 - hit[:, ::-1].argmax(-1)
        return (
            np.where(some, t[rows, first], np.nan), np.where(some, t[rows, last], np.nan),
            np.where(beside, np.nan, leave),
        )  # fmt: skip


def _seen(camera: Camera, centres: np.ndarray, near: float, far: float) -> np.ndarray:
    """Return which points (P, 3) a camera with a wide lens shows between two distances, as bool (P,)."""
    pixels, distance = camera.project(centres.astype(np.float64))
    framed = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)  # false for NaN, which is not shown
    return framed & (distance >= near) & (distance <= far)


def _window(camera: Camera) -> tuple[float, float, float, float]:
    """Return the camera's frame on its image plane at depth 1: left, right, bottom, top, with the lens undone."""
    u, v = np.meshgrid([0, camera.width / 2, camera.width], [0, camera.height / 2, camera.height])
    plane = np.stack([(u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy], -1)
    if camera.lens.bends:
        plane = camera.lens.undistort(plane)
    (left, up), (right, down) = plane.min(0), plane.max(0)
    return float(left), float(right), float(-down), float(-up)


def _grown(cells: np.ndarray) -> np.ndarray:
    """Add the neighbours of all cells along each axis, edges and corners included."""
    for axis in range(3):
        wide = np.moveaxis(cells, axis, 0)
        done = wide.copy()
        done[1:] |= wide[:-1]
        done[:-1] |= wide[1:]
        cells = np.moveaxis(done, 0, axis)
    return cells
