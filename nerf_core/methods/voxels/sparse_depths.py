"""The rays of training photos towards the sparse points that they see, for the loss of depth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space


class SparseDepths(NamedTuple):
    """K rays, and where they meet points: t (K,) in the coordinates of the scene's `Space`."""

    rays: Rays
    t: Tensor

    @staticmethod
    def of(scene: Scene, train_images: int) -> SparseDepths:
        """Return one ray for each point that a training photo sees, without those that masks hide.

        Args:
            scene: the scene.
            train_images: how many training photos are used; see `Scene.trained`.

        Raises:
            UserError: no training photo is known to see a point.
        """
        parts = _parts(scene, train_images)
        if not parts:
            raise UserError(
                "depth_weight needs sparse points that training photos see, as a COLMAP model has them, and no "
                f"--refine-poses; {scene.name} ({scene.format}) has none that count: leave it at 0"
            )
        names = ("origins", "directions", "near", "far")
        rays = Rays(*(torch.cat([getattr(part.rays, name) for part in parts]) for name in names))
        return SparseDepths(rays, torch.cat([part.t for part in parts]))

    @staticmethod
    def known(scene: Scene, train_images: int) -> bool:
        """Return whether a training photo is known to see a point, so that `of` raises nothing."""
        return bool(_parts(scene, train_images))

    def some(self, count: int, generator: torch.Generator) -> SparseDepths:
        """Draw rays, with replacement."""
        chosen = torch.randint(len(self.t), (count,), generator=generator)
        return SparseDepths(self.rays[chosen], self.t[chosen])


def _parts(scene: Scene, train_images: int) -> list[SparseDepths]:
    """The rays of each training photo that has any."""
    return [part for view in scene.trained(train_images) if len((part := _of_view(scene, view)).t)]


def _of_view(scene: Scene, index: int) -> SparseDepths:
    """The rays of one photo. Where a wide lens's near and far are distances, a point's depth is its distance too."""
    camera, sighted = scene.views[index].camera, scene.views[index].sighted
    points = np.empty((0, 3)) if sighted is None else sighted.astype(np.float64)
    pixels, depth = camera.project(points)
    offset = points - camera.c2w[:, 3]
    # a point before the near bound is an outlier, and what lies before it is not drawn
    seen = (depth > scene.near) & (pixels >= 0).all(-1) & (pixels < (camera.width, camera.height)).all(-1)
    # of a large capture, it depends on the clock which photos are already known to be damaged
    if not scene.photos.damaged(index) and (mask := scene.photos.mask(index)) is not None:
        column, row = np.where(seen[:, None], pixels, 0).astype(int).T
        seen &= mask[row, column]
    offset, depth = offset[seen], depth[seen]
    distance = np.linalg.norm(offset, axis=-1)
    origins = np.broadcast_to(camera.c2w[:, 3], offset.shape)
    parts = origins, offset / distance[:, None], scene.near * distance / depth, scene.far * distance / depth, distance
    *four, distance = (torch.from_numpy(v.astype(np.float32)) for v in parts)
    rays = Rays(*four)
    return SparseDepths(rays, Space.of(scene).box_t(rays, distance))
