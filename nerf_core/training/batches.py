"""Which pixels a training step sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.fast_rays import photo_colors
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw


class _Level:
    """The training photos at one size."""

    def __init__(self, photos: Photos, cameras: list[Camera], scene: Scene) -> None:
        self.cameras = Cameras(cameras, scene.near, scene.far)
        self.sizes = torch.from_numpy(photos.sizes)
        counts = self.sizes.prod(-1)
        self.offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        self.pixels, self.starts = photos.flat, torch.from_numpy(photos.starts)


class PixelSampler:
    """Random rays of the training photos with their colours; draws from a generator of its own.

    Pixels are drawn with replacement (the official code draws without; a batch that repeats one of its 1,024 among
    640,000 pixels is rare). Photos may differ in size: a photo is drawn in proportion to its pixels.
    train_images: only so many photos, evenly spread (0: all).
    """

    def __init__(self, scene: Scene, train_images: int, device: torch.device, seed: int) -> None:
        views = list(scene.split("train"))
        if not views:
            raise UserError(f"{scene.name}: no training photos: every photo is held out")
        if 0 < train_images < len(views):
            kept = np.linspace(0, len(views) - 1, train_images).round().astype(int)
            views = [views[i] for i in kept]
        self.scene, self.views, self.device = scene, views, device
        self.generator = torch.Generator().manual_seed(seed)
        self._photos: dict[int, _Level] = {}

    def draw(self, wanted: Draw) -> tuple[Rays, Tensor]:
        """Rays and their true colours (R, 3) float32."""
        count, photos = wanted.rays, self._at(wanted.shrink)
        if wanted.one_image:
            index = self._integers(len(photos.sizes), 1).expand(count)
        else:
            index = torch.searchsorted(photos.offsets, self._integers(int(photos.offsets[-1]), count), right=True) - 1
        size = photos.sizes[index]
        window = size
        if wanted.crop < 1:
            window = (size * wanted.crop).long().clamp(min=1)
        where = torch.rand(count, 2, generator=self.generator, dtype=torch.float64)
        # a product of a float below 1 and an integer can still round up to the integer
        pixel = (size - window) // 2 + torch.minimum((where * window).long(), window - 1)
        colors = photo_colors(index, pixel, photos.sizes[:, 0], photos.starts, photos.pixels)
        return photos.cameras.rays(index, pixel + 0.5).to(self.device), colors.to(self.device)

    def _at(self, shrink: int) -> _Level:
        """The photos at 1/shrink of their size. Those of one size are kept; a later level has no use for an earlier."""
        if shrink not in self._photos:
            self._photos = {}  # its memory first
            photos = self.scene.photos.at(self.views)
            cameras = [self.scene.views[i].camera for i in self.views]
            if shrink > 1:
                cameras = [shrunk_camera(camera, shrink) for camera in cameras]
                photos = shrunk(photos, [(camera.width, camera.height) for camera in cameras], shrink)
            self._photos = {shrink: _Level(photos, cameras, self.scene)}
        return self._photos[shrink]

    def _integers(self, below: int, count: int) -> Tensor:
        return torch.randint(below, (count,), generator=self.generator)

    def state(self) -> dict[str, Tensor]:
        return {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.generator.set_state(state["generator"])


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """Of a photo averaged over blocks of factor × factor pixels; what is left over at the far edges is dropped.

    A photo with less than one block a side is averaged less.
    """
    factor = min(factor, camera.width, camera.height)
    width, height = camera.width // factor, camera.height // factor
    return replace(camera, width=width * factor, height=height * factor).resized(width, height)


def shrunk(photos: Photos, sizes: Sequence[tuple[int, int]], factor: int) -> Photos:
    """Photos averaged over blocks of factor × factor pixels to `sizes` (width, height), as `shrunk_camera` has them."""
    small = Photos.empty(sizes)
    for image, room in zip(photos.images, small.images, strict=True):
        height, width = room.shape[:2]
        side = min(factor, *image.shape[:2])
        blocks = image[: height * side, : width * side].reshape(height, side, width, side, 3)
        room[:] = blocks.mean((1, 3), dtype=np.float32) + np.float32(0.5)
    return small
