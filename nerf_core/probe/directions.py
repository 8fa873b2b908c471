"""The colours that one point emits, over the sphere and over a disc, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

SPHERE_ROWS, SPHERE_COLUMNS = 48, 96  # 4,608 directions over the sphere
DISC_SIZE = 73  # some 4,180 more over the hemisphere that faces the viewer, or around the normal

Around = Literal["viewer", "normal"]


@dataclass(frozen=True)
class RadianceProbe:
    """The colour that one point emits towards directions v (unit, from the point outwards): c(x, d = −v).

    directions: (K, 3); the first SPHERE_ROWS × SPHERE_COLUMNS cover the sphere row by row, from +up to −up, azimuth
    growing along a row; the rest are the disc's pixels inside the unit circle, row by row.
    rgb: (K, 3), the point alone. back_rgb: (3,), the same towards where the ray comes from. frozen_rgb: (K, 3), the
    pixel if every sample of the ray kept its weight and showed the colour that it emits towards v: Σ w_i c(x_i, −v) and
    background.
    axes: (3, 3) rows right, up, towards the viewer or along the normal: what the disc is drawn in. up: the sphere map's
    pole; its azimuth 0 is `azimuth0`, growing towards cross(up, azimuth0). normal: ±∇σ, unit, on the viewer's side;
    None where σ is flat.
    dependence: see `view_dependence`.
    """

    step: int
    point: np.ndarray
    t: float
    directions: np.ndarray
    rgb: np.ndarray
    back_rgb: np.ndarray
    frozen_rgb: np.ndarray
    axes: np.ndarray
    up: np.ndarray
    azimuth0: np.ndarray
    normal: np.ndarray | None
    around: Around
    dependence: float

    def sphere_image(self, frozen: bool = False) -> np.ndarray:
        """(SPHERE_ROWS, SPHERE_COLUMNS, 3) float32."""
        rgb = self.frozen_rgb if frozen else self.rgb
        return rgb[: SPHERE_ROWS * SPHERE_COLUMNS].reshape(SPHERE_ROWS, SPHERE_COLUMNS, 3)

    def disc_image(self, frozen: bool = False) -> np.ndarray:
        """(DISC_SIZE, DISC_SIZE, 4) float32, row 0 at the top, alpha 0 outside the circle."""
        inside = disc_grid()[2]
        image = np.zeros((DISC_SIZE, DISC_SIZE, 4), np.float32)
        image[inside, :3] = (self.frozen_rgb if frozen else self.rgb)[SPHERE_ROWS * SPHERE_COLUMNS :]
        image[inside, 3] = 1
        return image

    def sphere_position(self, direction: np.ndarray) -> np.ndarray:
        """Where unit directions (..., 3) lie on the map: (..., 2) column and row in [0, 1), from the top left."""
        side = np.cross(self.up, self.azimuth0)
        azimuth = np.arctan2(direction @ side, direction @ self.azimuth0) % (2 * np.pi)
        polar = np.arccos(np.clip(direction @ self.up, -1, 1))
        return np.stack([azimuth / (2 * np.pi), polar / np.pi], -1)

    def disc_position(self, direction: np.ndarray) -> np.ndarray:
        """Where unit directions (..., 3) lie on the disc: (..., 2) in [−1, 1], y up; NaN on the far hemisphere."""
        xyz = direction @ self.axes.T
        return np.where(xyz[..., 2:] >= 0, xyz[..., :2], np.nan)

    def slice(self, azimuth: float, frozen: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """The disc along its diameter at `azimuth` (radians from the disc's right): angles (A,) from its axis, as
        far to either side as the middle of its outermost pixel, some 80°, and colours (A, 3)."""
        most = np.arcsin((DISC_SIZE - 1) / DISC_SIZE)
        angles = np.linspace(-most, most, 2 * DISC_SIZE - 1)
        image, r = self.disc_image(frozen), np.sin(angles)
        x, y = r * np.cos(azimuth), r * np.sin(azimuth)
        return angles, _bilinear(image, (x + 1) / 2 * DISC_SIZE - 0.5, (1 - y) / 2 * DISC_SIZE - 0.5)

    def slice_position(self, direction: np.ndarray, azimuth: float) -> tuple[float, float]:
        """Of a unit direction the angle within a slice's plane, and how far out of the plane it lies, in radians."""
        x, y, z = self.axes @ direction
        along, across = x * np.cos(azimuth) + y * np.sin(azimuth), y * np.cos(azimuth) - x * np.sin(azimuth)
        return float(np.arctan2(along, z)), float(np.arcsin(np.clip(across, -1, 1)))


@cache
def disc_grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y (y up) of the disc's pixel centres and which of them lie inside: three (DISC_SIZE, DISC_SIZE) arrays, to be
    read alone."""
    centres = (np.arange(DISC_SIZE) + 0.5) / DISC_SIZE * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    found = x, y, x * x + y * y < 1
    for array in found:
        array.flags.writeable = False
    return found


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(A, 3) at texel coordinates of an (h, w, 4) image, weighted by alpha: nothing bleeds in from outside."""
    total = np.zeros((len(x), 4))
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    for i, wy in ((0, 1 - (y - row)), (1, y - row)):
        for j, wx in ((0, 1 - (x - column)), (1, x - column)):
            texel = image[np.clip(row + i, 0, len(image) - 1), np.clip(column + j, 0, image.shape[1] - 1)]
            weight = np.maximum(wx * wy, 1e-9)[:, None] * texel[:, 3:]  # 1e-9: at the rim any inside texel will do
            total += weight * np.concatenate([texel[:, :3], np.ones((len(x), 1))], -1)
    return total[:, :3] / np.maximum(total[:, 3:], 1e-12)
