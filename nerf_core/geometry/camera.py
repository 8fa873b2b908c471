"""One camera: intrinsics, lens and pose.

Camera axes are OpenGL's: x right, y up, looking along −z. Pixel (i, j), column i and row j from the top left,
has its centre at (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nerf_core.geometry.lens import PINHOLE, Lens

INTRINSICS = 15  # numbers in `Camera.intrinsics`


@dataclass(frozen=True)
class Camera:
    """A camera with a lens, all lengths in pixels.

    c2w: (3, 4) float64, camera to world, rotation orthonormal.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    c2w: np.ndarray
    lens: Lens = PINHOLE

    def intrinsics(self) -> tuple[float, ...]:
        """Everything but the pose: width, height, fx, fy, cx, cy, then `Lens.coefficients`."""
        return self.width, self.height, self.fx, self.fy, self.cx, self.cy, *self.lens.coefficients

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera with another number of pixels and the same field of view.

        The lens coefficients stay: they apply to the image plane, whose unit is the focal length.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def shrunk(self, factor: int) -> Camera:
        """Return the camera of a photo that is averaged over blocks of factor × factor pixels.

        Pixels at the right and lower edges that fill no block are dropped. A photo smaller than `factor` on a side is
        averaged over smaller blocks.
        """
        factor = min(factor, self.width, self.height)
        width, height = self.width // factor, self.height // factor
        return replace(self, width=width * factor, height=height * factor).resized(width, height)

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Return the directions (P, 3), in the camera's axes, through pixel coordinates (P, 2): `Lens.directions`."""
        return self.lens.directions((np.asarray(pixels) - (self.cx, self.cy)) / (self.fx, self.fy))

    def moved(self, c2w: np.ndarray) -> Camera:
        """Return the camera with another pose: the first 3 rows of `c2w`, (3, 4) or (4, 4)."""
        return replace(self, c2w=np.asarray(c2w, dtype=np.float64)[:3, :4])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points into the picture.

        Args:
            points: (P, 3) in world units.

        Returns:
            Pixel coordinates (P, 2) and z-depths (P,); for a wide lens, distances. A point with depth ≤ 0 lies behind
            the camera. The coordinates are NaN where the lens shows something else at that pixel; see `Lens.see`.
        """
        local = (points - self.c2w[:, 3]) @ self.c2w[:, :3]
        done = project(local, np.array(self.intrinsics(), np.float64))
        done.pixels[done.framed & ~done.shown] = np.nan
        return done.pixels, done.depth


class Projected(NamedTuple):
    """P points projected into pictures.

    pixels: (P, 2) column and row.
    depth: (P,) z-depth, or distance for a wide lens; a point with depth ≤ 0 lies behind the camera.
    framed: (P,) whether the pixel lies in the picture and the point in front of the camera.
    shown: (P,) whether the lens shows the point at that pixel, and not something else; see `Lens.see`.
    """

    pixels: np.ndarray
    depth: np.ndarray
    framed: np.ndarray
    shown: np.ndarray


def project(local: np.ndarray, intrinsics: np.ndarray) -> Projected:
    """Project points that are given in camera axes.

    Args:
        local: (P, 3) in world units.
        intrinsics: those of one camera, (INTRINSICS,), or of a camera for each point, (P, INTRINSICS); see
            `Camera.intrinsics`.
    """
    width, height, fx, fy, cx, cy, *coefficients = intrinsics.T
    bent, depth, shown = Lens(*coefficients).see(local)
    pixels = bent * np.stack([fx, fy], -1) + np.stack([cx, cy], -1)
    framed = (depth > 0) & (pixels >= 0).all(-1) & (pixels < np.stack([width, height], -1)).all(-1)
    return Projected(pixels, depth, framed, shown)
