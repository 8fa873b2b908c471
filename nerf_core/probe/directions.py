"""The colours that a layer, a point or a whole ray shows, on a map of the sphere and on a disc, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

SPHERE_ROWS, SPHERE_COLUMNS = 48, 96  # pixels of the sphere map: 4,608 directions
DISC_SIZE = 73  # pixels on a side of the disc: some 4,180 directions over one hemisphere

Around = Literal["viewer", "normal"]
Source = Literal["layer", "point", "ray"]


@dataclass(frozen=True)
class RadianceProbe:
    """The colours that a point of a ray, its layer, and the whole ray show towards K directions v.

    A direction v is a unit vector from the point outwards. A method takes ray directions d from the camera to the
    point, so the colour towards v is c(x, d = −v). Colours are float32 in [0, 1].

    step: the training step of the model.
    point: (3,) the point x, in world units.
    t: the point's distance along the ray, in world units.
    directions: (K, 3). The first SPHERE_ROWS × SPHERE_COLUMNS are the pixels of the sphere map, row by row. Rows go
        from +up to −up, and the azimuth grows along a row. The others are the disc's pixels inside the circle.
    rgb: (K, 3) the colours that the point emits.
    back_rgb: (3,) the colour that the point emits towards the ray's origin.
    dependence: how much these colours differ; see `view_dependence`.
    layer: (2,) where the point's layer on the ray begins and ends, as world distances; None if the point is in none.
    layer_rgb: (K, 3) Σ w_i c(x_i, −v) / Σ w_i over the samples of the layer: those of the ray's last pass whose stretch
        meets it. Those of the point without a layer.
    layer_back_rgb: (3,) the same towards the ray's origin: the layer's part of the pixel's colour.
    layer_dependence: how much these colours differ.
    frozen_rgb: (K, 3) Σ w_i c(x_i, −v) + (1 − Σ w_i) background: the pixel if every sample of the ray kept its weight
        and showed the colour that it emits towards v.
    axes: (3, 3) the disc's axes as rows: right, up, and the direction at its centre, which `around` names.
    up: (3,) unit, the pole of the sphere map.
    azimuth0: (3,) unit, the direction of azimuth 0 on the sphere map. The azimuth grows towards cross(up, azimuth0).
    normal: (3,) unit, the density's normal on the viewer's side; None if there is none. See `density_normal`.
    around: the direction at the disc's centre: to the viewer, or the normal.
    default: whose colours are shown unless another source is asked for: the layer's; the point's if the point was
        asked for or has no layer.
    """

    step: int
    point: np.ndarray
    t: float
    directions: np.ndarray
    rgb: np.ndarray
    back_rgb: np.ndarray
    dependence: float
    layer: np.ndarray | None
    layer_rgb: np.ndarray
    layer_back_rgb: np.ndarray
    layer_dependence: float
    frozen_rgb: np.ndarray
    axes: np.ndarray
    up: np.ndarray
    azimuth0: np.ndarray
    normal: np.ndarray | None
    around: Around
    default: Source

    def colors(self, of: Source | None = None) -> np.ndarray:
        """Return the colours (K, 3) of a source: `layer_rgb`, `rgb` or `frozen_rgb`. None takes `default`."""
        return {"layer": self.layer_rgb, "point": self.rgb, "ray": self.frozen_rgb}[of or self.default]

    def sphere_image(self, of: Source | None = None) -> np.ndarray:
        """Return the sphere map of a source, (SPHERE_ROWS, SPHERE_COLUMNS, 3) float32; see `colors`."""
        return self.colors(of)[: SPHERE_ROWS * SPHERE_COLUMNS].reshape(SPHERE_ROWS, SPHERE_COLUMNS, 3)

    def disc_image(self, of: Source | None = None) -> np.ndarray:
        """Return the disc of a source, (DISC_SIZE, DISC_SIZE, 4) float32 RGBA; see `colors`.

        Row 0 is at the top, and alpha is 0 outside the circle.
        """
        inside = disc_grid()[2]
        image = np.zeros((DISC_SIZE, DISC_SIZE, 4), np.float32)
        image[inside, :3] = self.colors(of)[SPHERE_ROWS * SPHERE_COLUMNS :]
        image[inside, 3] = 1
        return image

    def sphere_position(self, direction: np.ndarray) -> np.ndarray:
        """Return where directions lie on the sphere map.

        Args:
            direction: (..., 3) unit vectors.

        Returns:
            (..., 2) column and row, in [0, 1] from the top left.
        """
        side = np.cross(self.up, self.azimuth0)
        azimuth = np.arctan2(direction @ side, direction @ self.azimuth0) % (2 * np.pi)
        polar = np.arccos(np.clip(direction @ self.up, -1, 1))
        return np.stack([azimuth / (2 * np.pi), polar / np.pi], -1)

    def disc_position(self, direction: np.ndarray) -> np.ndarray:
        """Return where directions lie on the disc.

        Args:
            direction: (..., 3) unit vectors.

        Returns:
            (..., 2) x and y in [−1, 1], y up; NaN for directions of the far hemisphere.
        """
        xyz = direction @ self.axes.T
        return np.where(xyz[..., 2:] >= 0, xyz[..., :2], np.nan)

    def slice(self, azimuth: float, of: Source | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the colours along a diameter of the disc.

        Args:
            azimuth: the diameter's angle from the disc's right, in radians.
            of: the source; see `colors`.

        Returns:
            Angles (A,) from the disc's axis in radians, and colours (A, 3). The angles end at the centre of the
            outermost pixel on either side, at some 80°.
        """
        most = np.arcsin((DISC_SIZE - 1) / DISC_SIZE)
        angles = np.linspace(-most, most, 2 * DISC_SIZE - 1)
        image, r = self.disc_image(of), np.sin(angles)
        x, y = r * np.cos(azimuth), r * np.sin(azimuth)
        return angles, _bilinear(image, (x + 1) / 2 * DISC_SIZE - 0.5, (1 - y) / 2 * DISC_SIZE - 0.5)

    def slice_position(self, direction: np.ndarray, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where directions lie relative to the plane of a slice.

        Args:
            direction: (..., 3) unit vectors.
            azimuth: that of `slice`, in radians.

        Returns:
            The angles (...) from the disc's axis within the plane, and those out of the plane, in radians.
        """
        x, y, z = np.moveaxis(direction @ self.axes.T, -1, 0)
        along, across = x * np.cos(azimuth) + y * np.sin(azimuth), y * np.cos(azimuth) - x * np.sin(azimuth)
        return np.arctan2(along, z), np.arcsin(np.clip(across, -1, 1))


@cache
def disc_grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x and y (y up, in [−1, 1]) of the disc's pixel centres, and which of them lie inside the circle.

    These are three read-only arrays (DISC_SIZE, DISC_SIZE), the last one bool.
    """
    centres = (np.arange(DISC_SIZE) + 0.5) / DISC_SIZE * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    found = x, y, x * x + y * y < 1
    for array in found:
        array.flags.writeable = False
    return found


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate an image (h, w, 4) at pixel coordinates x, y (A,). Returns colours (A, 3).

    Pixels are weighted by their alpha, so that nothing bleeds in from outside the circle.
    """
    total = np.zeros((len(x), 4))
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    for i, wy in ((0, 1 - (y - row)), (1, y - row)):
        for j, wx in ((0, 1 - (x - column)), (1, x - column)):
            texel = image[np.clip(row + i, 0, len(image) - 1), np.clip(column + j, 0, image.shape[1] - 1)]
            weight = np.maximum(wx * wy, 1e-9)[:, None] * texel[:, 3:]  # 1e-9: at the rim, any pixel inside counts
            total += weight * np.concatenate([texel[:, :3], np.ones((len(x), 1))], -1)
    return total[:, :3] / np.maximum(total[:, 3:], 1e-12)
