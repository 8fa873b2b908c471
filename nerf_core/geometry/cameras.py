"""Pixels of many cameras to rays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.fast_rays import fast_rays
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.rays import Rays


class Cameras:
    """N cameras as tensors, so that one batch of rays may come from all of them."""

    def __init__(self, cameras: Sequence[Camera], near: float, far: float) -> None:
        table = np.array([c.intrinsics() for c in cameras], dtype=np.float64)
        self.size = torch.from_numpy(table[:, :2]).long()
        self.focal = torch.from_numpy(table[:, 2:4])
        self.principal = torch.from_numpy(table[:, 4:6])
        self.lens = torch.from_numpy(table[:, 6:])
        self.c2w = torch.from_numpy(np.stack([np.asarray(c.c2w, dtype=np.float64) for c in cameras]))
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
        """`rays` where numba is missing."""
        plane = (pixels.double() - self.principal[index]) / self.focal[index]
        if self._distorted:
            lens = Lens(*self.lens[index].numpy().T)
            plane = torch.from_numpy(lens.undistort(plane.numpy()))
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
