"""Pixels to rays: intrinsics, lens distortion, normalised device coordinates.

Camera axes are OpenGL's: x right, y up, looking along −z. Pixel (i, j), column i and row j from the top left,
has its centre at (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.fast_rays import fast_rays
from nerf_core.geometry.rays import Rays

Lens = float | np.ndarray
FAR_OFF = 1e9  # of the image plane: where Newton is thrown to by a lens that no one has built; it then found nothing
BESIDE = 1e6  # of the image plane: what lies farther out is beside the camera; a lens takes that to its seventh power
SAME_PLACE = 1e-3  # on the image plane: a place that undistorting finds again; what is folded is off by far more
UNDISTORT_STEPS = 10  # Newton converges quadratically: lenses that fold nowhere in the image need 3 to 5


@dataclass(frozen=True)
class Camera:
    """A pinhole with OpenCV's radial-tangential lens (k1, k2, k3, p1, p2), all lengths in pixels.

    c2w: (3, 4) float64, camera to world, rotation orthonormal.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    c2w: np.ndarray
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def intrinsics(self) -> tuple[float, ...]:
        """width, height, fx, fy, cx, cy, k1, k2, k3, p1, p2: what makes two cameras see alike but for pose."""
        return (
            self.width, self.height, self.fx, self.fy, self.cx, self.cy,
            self.k1, self.k2, self.k3, self.p1, self.p2,
        )  # fmt: skip

    def resized(self, width: int, height: int) -> Camera:
        """The same field of view over another number of pixels; the lens coefficients do not depend on it."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def moved(self, c2w: np.ndarray) -> Camera:
        return replace(self, c2w=np.asarray(c2w, dtype=np.float64)[:3, :4])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (P, 3) → pixel coordinates (P, 2) and z-depths (P,); points with depth ≤ 0 lie behind.

        NaN where they would fall into the picture, but the lens shows something else there: see `shown`.
        """
        local = (points - self.c2w[:, 3]) @ self.c2w[:, :3]
        z = -local[:, 2]
        safe = np.where(np.abs(z) < 1e-12, 1e-12, z)  # a point in the camera's plane has no pixel; depth tells
        plane, lens = np.stack([local[:, 0], -local[:, 1]], -1) / safe[:, None], self.intrinsics()[6:]
        if any(lens):
            plane = np.clip(plane, -BESIDE, BESIDE)
            bent = distort(plane, *lens)
            pixels = bent * (self.fx, self.fy) + (self.cx, self.cy)
            k = np.flatnonzero((z > 0) & (pixels >= 0).all(-1) & (pixels < (self.width, self.height)).all(-1))
            pixels[k[~shown(plane[k], bent[k], np.broadcast_to(lens, (len(k), 5)))]] = np.nan
            return pixels, z
        return plane * (self.fx, self.fy) + (self.cx, self.cy), z


def distort(xy: np.ndarray, k1: Lens, k2: Lens, k3: Lens, p1: Lens, p2: Lens) -> np.ndarray:
    """Ideal image-plane points (P, 2), y down → where the lens puts them (OpenCV's model); one lens, or P of them."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def shown(plane: np.ndarray, bent: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Which ideal points (P, 2) a lens (P, 5) shows where `distort` puts them, at `bent` (P, 2): bool (P,).

    Far outside of the picture its polynomial may turn back and fold them into it; what is seen there lies elsewhere.
    """
    back = undistort(torch.from_numpy(bent), torch.tensor(lens)).numpy()
    return np.abs(back - plane).max(-1) < SAME_PLACE


def undistort(xy: Tensor, lens: Tensor) -> Tensor:
    """Inverse of `distort` by Newton's method: xy (R, 2) and lens (R, 5) = k1, k2, k3, p1, p2 → (R, 2), float64.

    Where the Jacobian degenerates (beyond the fold of an absurd calibration) the point stays where it is; where that
    throws it out of all bounds, the lens is left out.
    """
    k1, k2, k3, p1, p2 = lens.unbind(-1)
    x0, y0 = xy.unbind(-1)
    x, y = x0, y0
    for _ in range(UNDISTORT_STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r²
        ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x0
        ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y0
        xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        xy_ = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        det = xx * yy - xy_ * xy_
        ok = det.abs() > 1e-9  # a fold of the lens: no unique inverse beyond it
        inverse = torch.where(ok, 1 / torch.where(ok, det, torch.ones_like(det)), torch.zeros_like(det))
        x = x - (yy * ex - xy_ * ey) * inverse
        y = y - (xx * ey - xy_ * ex) * inverse
    lost = ~(x.abs() + y.abs() < FAR_OFF)  # no number at all among them
    return torch.stack([torch.where(lost, x0, x), torch.where(lost, y0, y)], -1)


class Cameras:
    """N cameras as tensors, so that one batch of rays may come from all of them."""

    def __init__(self, cameras: Sequence[Camera], near: float, far: float, device: torch.device | None = None) -> None:
        table = np.array([c.intrinsics() for c in cameras], dtype=np.float64)
        self.size = torch.from_numpy(table[:, :2]).long().to(device)
        self.focal = torch.from_numpy(table[:, 2:4]).to(device)
        self.principal = torch.from_numpy(table[:, 4:6]).to(device)
        self.lens = torch.from_numpy(table[:, 6:]).to(device)
        self.c2w = torch.from_numpy(np.stack([np.asarray(c.c2w, dtype=np.float64) for c in cameras])).to(device)
        self.near, self.far = near, far
        self._distorted = bool((self.lens != 0).any())

    def rays(self, index: Tensor, pixels: Tensor) -> Rays:
        """Rays through `pixels` (R, 2) (column, row; centres at +0.5) of the cameras `index` (R,); float32.

        A pixel's direction is ((i − cx)/fx, −(j − cy)/fy, −1) after undoing the lens, rotated by c2w and made
        unit; near and far are z-depths, so along the ray they grow by the length of that vector.
        """
        done = fast_rays(
            index, pixels, self.focal, self.principal, self.lens, self.c2w, float(self.near), float(self.far)
        )
        return Rays(*done) if done is not None else self.plain_rays(index, pixels)

    def plain_rays(self, index: Tensor, pixels: Tensor) -> Rays:
        """`rays` in torch operations."""
        plane = (pixels.double() - self.principal[index]) / self.focal[index]
        if self._distorted:
            plane = undistort(plane, self.lens[index])
        local = torch.stack([plane[:, 0], -plane[:, 1], -torch.ones_like(plane[:, 0])], -1)
        length = local.norm(dim=-1)
        c2w = self.c2w[index]
        directions = torch.einsum("rij,rj->ri", c2w[:, :, :3], local / length[:, None])
        return Rays(
            origins=c2w[:, :, 3].float(),
            directions=directions.float(),
            near=(self.near * length).float(),
            far=(self.far * length).float(),
        )


def camera_rays(camera: Camera, near: float, far: float, pixels: np.ndarray | None = None) -> Rays:
    """Rays of one camera through integer `pixels` (R, 2) (column, row), or through all, row by row."""
    if pixels is None:
        rows, columns = np.mgrid[: camera.height, : camera.width]
        pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    centres = torch.from_numpy(np.asarray(pixels, dtype=np.float64) + 0.5)
    return Cameras([camera], near, far).rays(torch.zeros(len(centres), dtype=torch.long), centres)


@dataclass(frozen=True)
class Ndc:
    """The frustum of normalised device coordinates: one reference camera at the origin, looking along −z.

    NeRF, appendix C (arXiv:2003.08934): with the near plane at z = −near, t′ ∈ [0, 1] is linear in disparity.
    far: the scene's far bound (z-depth), where exported distances of t′ → 1 are clamped.
    """

    width: int
    height: int
    focal: float
    near: float
    far: float

    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """World rays (R, 3) → NDC origins, NDC directions (not unit: t′ runs 0…1), and which rays (R,) exist.

        Only a ray that points to −z meets the frustum's far end; the others get a harmless stand-in.
        """
        exists = directions[:, 2] < -1e-6  # parallel to the image plane: never reaches the near plane
        dz = torch.where(exists, directions[:, 2], -torch.ones_like(directions[:, 2]))
        shift = -(self.near + origins[:, 2]) / dz
        o = origins + shift[:, None] * directions
        sx, sy = 2 * self.focal / self.width, 2 * self.focal / self.height
        oz = -self.near
        o_ndc = torch.stack([-sx * o[:, 0] / oz, -sy * o[:, 1] / oz, torch.full_like(dz, 1 + 2 * self.near / oz)], -1)
        d_ndc = torch.stack(
            [
                -sx * (directions[:, 0] / dz - o[:, 0] / oz),
                -sy * (directions[:, 1] / dz - o[:, 1] / oz),
                torch.full_like(dz, -2 * self.near / oz),
            ],
            -1,
        )
        return o_ndc, d_ndc, exists

    def first(self, origins: Tensor) -> Tensor:
        """World origins (R, 3) → the t′ (R,) at which their rays begin: 0, or beyond the near plane the origin's own.

        Where world_t is 0: t′ / (1 − t′) = −(near + o_z) / near. What lies behind a camera that flew in is not seen.
        """
        beyond = ((-self.near - origins[:, 2]) / self.near).clamp(min=0)
        return beyond / (1 + beyond)

    def world_t(self, origins: Tensor, directions: Tensor, t_ndc: Tensor) -> Tensor:
        """t′ (R, S) → world distance (R, S), clamped where the ray leaves the scene's far bound.

        On the shifted ray t′ = 1 − o_z / (o_z + t d_z), hence t = (o_z / d_z) (1/(1 − t′) − 1) with o_z = −near.
        """
        shift, scale = self._along(origins, directions)
        t = t_ndc.clamp(max=1 - self.near / self.far)
        return shift + scale * (t / (1 - t))

    def _along(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """shift and scale (R, 1) of the world distance shift + scale · t′ / (1 − t′)."""
        dz = torch.where(directions[:, 2] < -1e-6, directions[:, 2], -torch.ones_like(directions[:, 2]))
        return (-(self.near + origins[:, 2]) / dz)[:, None], (-self.near / dz)[:, None]

    def stretched(self, origins: Tensor, directions: Tensor, t: Tensor, delta: Tensor) -> Tensor:
        """World distances t (R, S) and lengths δ in NDC → the world distances (R, S) at which those lengths end."""
        shift, scale = self._along(origins, directions)
        ratio = (t - shift) / scale  # t′ / (1 − t′)
        length = self.rays(origins, directions)[1].norm(dim=-1, keepdim=True)
        return self.world_t(origins, directions, ratio / (1 + ratio) + delta / length)

    def point(self, world: Tensor) -> Tensor:
        """World points (..., 3) in front of the origin → NDC points (..., 3)."""
        z = world[..., 2].clamp(max=-1e-6)  # the frustum has no points beside or behind its camera
        return torch.stack(
            [
                -2 * self.focal / self.width * world[..., 0] / z,
                -2 * self.focal / self.height * world[..., 1] / z,
                1 + 2 * self.near / z,
            ],
            -1,
        )
