"""Draw the pixels of a training step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

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


class Batch(NamedTuple):
    """The pixels of a training step.

    rays: R rays.
    colors: (R, 3) float32 in [0, 1], the photos' colours, sRGB-encoded.
    photo: (R,) int64 on the CPU, which photos: positions in `PixelSampler.views`.
    """

    rays: Rays
    colors: Tensor
    photo: Tensor


class _Level:
    """The training photos at one size.

    cameras: N cameras.
    sizes: (N, 2) int64, width and height.
    offsets: (N + 1,) int64; photo i has the pixels offsets[i] … offsets[i + 1] − 1, counted over all photos.
    pixels, starts: see `Photos.flat` and `Photos.starts`.
    """

    def __init__(self, photos: Photos, cameras: list[Camera], scene: Scene) -> None:
        self.cameras = Cameras(cameras, scene.near, scene.far)
        self.sizes = torch.from_numpy(photos.sizes)
        counts = self.sizes.prod(-1)
        self.offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        self.pixels, self.starts = photos.flat, torch.from_numpy(photos.starts)


class PixelSampler:
    """Draws random pixels of the training photos, as rays with their colours. It has a generator of its own.

    Pixels are drawn with replacement. NeRF's official code draws without, but among 640,000 pixels a batch of 1,024
    rarely repeats one. Photos may differ in size: a photo is drawn in proportion to its number of pixels.
    """

    def __init__(self, scene: Scene, train_images: int, device: torch.device, seed: int) -> None:
        """Choose the photos.

        Args:
            scene: the scene; its split "train" is used.
            train_images: how many of these photos, evenly spread; 0: all.
            device: where the rays and colours go.
            seed: of the generator.

        Raises:
            UserError: the scene has no training photos.
        """
        views = list(scene.trained(train_images))
        if not views:
            raise UserError(f"{scene.name}: no training photos: every photo is held out")
        self.scene, self.views, self.device = scene, views, device
        self.generator = torch.Generator().manual_seed(seed)
        self._photos: dict[int, _Level] = {}

    def draw(self, wanted: Draw, part: range | None = None) -> tuple[Rays, Tensor]:
        """Return the rays and colours of `batch`."""
        return self.batch(wanted, part)[:2]

    def batch(self, wanted: Draw, part: range | None = None) -> Batch:
        """Draw the pixels of one training step.

        Args:
            wanted: how many, and from which part of the photos.
            part: return only these of them; the generator moves on as for all. None: all.
        """
        count, photos = wanted.rays, self._at(wanted.shrink)
        if wanted.one_image:
            index = self._integers(len(photos.sizes), 1).expand(count)
        else:
            index = torch.searchsorted(photos.offsets, self._integers(int(photos.offsets[-1]), count), right=True) - 1
        where = torch.rand(count, 2, generator=self.generator, dtype=torch.float64)
        if part is not None:
            index, where = index[part.start : part.stop], where[part.start : part.stop]
        size = photos.sizes[index]
        window = size
        if wanted.crop < 1:
            window = (size * wanted.crop).long().clamp(min=1)
        # the minimum, because a product of a float below 1 and an integer can round up to the integer
        pixel = (size - window) // 2 + torch.minimum((where * window).long(), window - 1)
        colors = photo_colors(index, pixel, photos.sizes[:, 0], photos.starts, photos.pixels)
        return Batch(photos.cameras.rays(index, pixel + 0.5).to(self.device), colors.to(self.device), index)

    def _at(self, shrink: int) -> _Level:
        """Return the photos at 1/shrink of their size. Only the last size is kept: schedules do not go back to one."""
        if shrink not in self._photos:
            self._photos = {}  # frees the memory first
            photos = self.scene.photos.at(self.views)
            cameras = [self.scene.views[i].camera for i in self.views]
            if shrink > 1:
                cameras = [camera.shrunk(shrink) for camera in cameras]
                photos = shrunk(photos, [(camera.width, camera.height) for camera in cameras], shrink)
            self._photos = {shrink: _Level(photos, cameras, self.scene)}
        return self._photos[shrink]

    def _integers(self, below: int, count: int) -> Tensor:
        return torch.randint(below, (count,), generator=self.generator)

    def state(self) -> dict[str, Tensor]:
        """Return the state of the generator by name, for a checkpoint."""
        return {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError, RuntimeError or TypeError if it is not a generator's state."""
        self.generator.set_state(state["generator"])


def shrunk(photos: Photos, sizes: Sequence[tuple[int, int]], factor: int) -> Photos:
    """Average photos over blocks of factor × factor pixels.

    Args:
        photos: N photos.
        sizes: their new sizes (width, height), those of `Camera.shrunk`.
        factor: the side of a block, in pixels.
    """
    small = Photos.empty(sizes)
    for k, image in enumerate(photos.images):
        width, height = sizes[k]
        side = min(factor, *image.shape[:2])
        blocks = image[: height * side, : width * side].reshape(height, side, width, side, 3)
        small.put(k, (blocks.mean((1, 3), dtype=np.float32) + np.float32(0.5)).astype(np.uint16))
    return small
