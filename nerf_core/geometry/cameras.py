"""Turn pixels of many cameras into rays."""

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
    """N cameras as tensors, so that one batch can mix rays of all of them."""

    def __init__(self, cameras: Sequence[Camera], near: float, far: float) -> None:
        """Stack the cameras.

        Args:
            cameras: N cameras, at least one.
            near, far: z-depths that enclose the content, in world units; for a wide lens, distances.
        """
        table = np.array([c.intrinsics() for c in cameras], dtype=np.float64)
        self.size = torch.from_numpy(table[:, :2]).long()
        self.focal = torch.from_numpy(table[:, 2:4])
        self.principal = torch.from_numpy(table[:, 4:6])
        self.lens = torch.from_numpy(table[:, 6:])
        self.c2w = torch.from_numpy(np.stack([np.asarray(c.c2w, dtype=np.float64) for c in cameras]))
        self.near, self.far = near, far

    def rays(self, index: Tensor, pixels: Tensor) -> Rays:
        """Return the rays through pixels.

        A pixel (i, j) looks along ((i − cx)/fx, −(j − cy)/fy, −1) once the lens is undone. The vector is rotated by
        c2w and normalised. near and far are z-depths; along the ray they are longer by the length of that vector. The
        rays of a wide lens (`Lens.directions`) may run beside the image plane or away from it, where a z-depth means
        nothing. Their near and far are distances along the ray.

        Args:
            index: (R,) the camera of each ray.
            pixels: (R, 2) column and row; a pixel's centre lies at +0.5.

        Returns:
            R rays, float32.
        """
        done = fast_rays(
            index, pixels, self.focal, self.principal, self.lens, self.c2w, float(self.near), float(self.far)
        )
        return Rays(*done) if done is not None else self.plain_rays(index, pixels)

    def plain_rays(self, index: Tensor, pixels: Tensor) -> Rays:
        """The same as `rays`, without numba."""
        bent = (pixels.double() - self.principal[index]) / self.focal[index]
        lens = Lens(*self.lens[index].numpy().T)
        local = torch.from_numpy(lens.directions(bent.numpy()))
        length = local.norm(dim=-1)
        stretch = torch.where(self.lens[index, -1] != 0, 1.0, length)
        c2w = self.c2w[index]
        directions = torch.einsum("rij,rj->ri", c2w[:, :, :3], local / length[:, None])
        return Rays(
            origins=c2w[:, :, 3].float(),
            directions=directions.float(),
            near=(self.near * stretch).float(),
            far=(self.far * stretch).float(),
        )


def camera_rays(camera: Camera, near: float, far: float, pixels: np.ndarray | None = None) -> Rays:
    """Return the rays of one camera through the centres of its pixels.

    Args:
        camera: the camera.
        near, far: z-depths in world units; for a wide lens, distances.
        pixels: (R, 2) integer column and row; None takes all pixels row by row.
    """
    if pixels is None:
        rows, columns = np.mgrid[: camera.height, : camera.width]
        pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    centres = torch.from_numpy(np.asarray(pixels, dtype=np.float64) + 0.5)
    return Cameras([camera], near, far).rays(torch.zeros(len(centres), dtype=torch.long), centres)
