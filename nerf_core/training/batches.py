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
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw


class _Photos:
    """The training photos at one size."""

    def __init__(self, images: list[np.ndarray], cameras: list[Camera], scene: Scene) -> None:
        self.cameras = Cameras(cameras, scene.near, scene.far)
        self.sizes = torch.tensor([(image.shape[1], image.shape[0]) for image in images])
        counts = self.sizes.prod(-1)
        self.offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        self.pixels, self.starts = flattened(images)


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
        self._photos: dict[int, _Photos] = {}

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

    def _at(self, shrink: int) -> _Photos:
        """The photos at 1/shrink of their size. Those of one size are kept; a later level has no use for an earlier."""
        if shrink not in self._photos:
            self._photos = {}  # its memory first
            images = [self.scene.images[i] for i in self.views]
            cameras = [self.scene.views[i].camera for i in self.views]
            if shrink > 1:
                cameras = [shrunk_camera(camera, shrink) for camera in cameras]
                images = shrunk(images, [(camera.height, camera.width) for camera in cameras], shrink)
            self._photos = {shrink: _Photos(images, cameras, self.scene)}
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


def shrunk(images: Sequence[np.ndarray], sizes: Sequence[tuple[int, int]], factor: int) -> list[np.ndarray]:
    """uint16 (H, W, 3) photos averaged over blocks to `sizes` (height, width), as `shrunk_camera` has them; all lie in
    one array."""
    ends = np.cumsum([height * width for height, width in sizes])
    flat, results = np.empty((int(ends[-1]), 3), np.uint16), []
    for image, (height, width), end in zip(images, sizes, ends, strict=True):
        side = min(factor, *image.shape[:2])
        blocks = image[: height * side, : width * side].reshape(height, side, width, side, 3)
        small = flat[end - height * width : end].reshape(height, width, 3)
        small[:] = blocks.mean((1, 3), dtype=np.float32) + np.float32(0.5)
        results.append(small)
    return results


def flattened(images: list[np.ndarray]) -> tuple[np.ndarray, Tensor]:
    """Pixels (P, 3) uint16 and where in them each photo begins (N,): without a copy where one array holds all photos.

    That array may hold more than these, as `nerf_core.datasets` makes it for all splits.
    """
    whole = images[0].base
    if whole is not None and all(image.base is whole and image.flags.c_contiguous for image in images):
        flat = np.asarray(whole).reshape(-1, 3)
        bytes_before = [i.__array_interface__["data"][0] - flat.__array_interface__["data"][0] for i in images]
        return flat, torch.tensor(bytes_before) // flat.strides[0]
    counts = torch.tensor([0, *(image.shape[0] * image.shape[1] for image in images)])
    return np.concatenate([np.ascontiguousarray(image).reshape(-1, 3) for image in images]), counts.cumsum(0)[:-1]
