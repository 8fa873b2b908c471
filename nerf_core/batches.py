"""Which pixels a training step sees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from nerf_core.cameras import Cameras
from nerf_core.errors import UserError
from nerf_core.scene import Scene
from nerf_core.types import Rays


class BatchConfig(Protocol):
    """The part of a method's configuration that says how rays are drawn."""

    @property
    def rays(self) -> int: ...
    @property
    def one_image(self) -> bool: ...
    @property
    def precrop_steps(self) -> int: ...
    @property
    def precrop(self) -> float: ...
    @property
    def train_images(self) -> int: ...


class PixelSampler:
    """Random rays of the training photos with their colours; draws from a generator of its own.

    Pixels are drawn with replacement (the official code draws without; a batch that repeats one of its 1,024 among
    640,000 pixels is rare). Photos may differ in size: a photo is drawn in proportion to its pixels.
    """

    def __init__(self, scene: Scene, config: BatchConfig, device: torch.device, seed: int) -> None:
        views = list(scene.split("train"))
        if not views:
            raise UserError(f"{scene.name}: no training photos: every photo is held out")
        if 0 < config.train_images < len(views):
            kept = np.linspace(0, len(views) - 1, config.train_images).round().astype(int)
            views = [views[i] for i in kept]
        self.config, self.device = config, device
        self.generator = torch.Generator().manual_seed(seed)
        self.cameras = Cameras([scene.views[i].camera for i in views], scene.near, scene.far)
        self.images = [scene.images[i] for i in views]
        self.sizes = torch.tensor([(image.shape[1], image.shape[0]) for image in self.images])
        counts = self.sizes.prod(-1)
        self.offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])

    def draw(self, step: int) -> tuple[Rays, Tensor]:
        """The rays of training step `step` and their true colours (R, 3) float32."""
        count = self.config.rays
        if self.config.one_image:
            index = self._integers(len(self.sizes), 1).expand(count)
        else:
            index = torch.searchsorted(self.offsets, self._integers(int(self.offsets[-1]), count), right=True) - 1
        size = self.sizes[index]
        window = size
        if step < self.config.precrop_steps:
            window = (size * self.config.precrop).long().clamp(min=1)
        where = torch.rand(count, 2, generator=self.generator, dtype=torch.float64)
        # a product of a float below 1 and an integer can still round up to the integer
        pixel = (size - window) // 2 + torch.minimum((where * window).long(), window - 1)
        return self.cameras.rays(index, pixel + 0.5).to(self.device), self._colors(index, pixel).to(self.device)

    def _colors(self, index: Tensor, pixel: Tensor) -> Tensor:
        """What pixels (R, 2) of photos `index` (R,) show, (R, 3) float32; one gather a photo, since sizes differ."""
        photo, (column, row) = index.numpy(), pixel.numpy().T
        order = np.argsort(photo, kind="stable")
        colors = np.empty((len(photo), 3), np.uint16)
        for same in np.split(order, np.flatnonzero(np.diff(photo[order])) + 1):
            colors[same] = self.images[photo[same[0]]][row[same], column[same]]
        return torch.from_numpy(colors.astype(np.float32) / 65535)

    def _integers(self, below: int, count: int) -> Tensor:
        return torch.randint(below, (count,), generator=self.generator)

    def state(self) -> dict[str, Tensor]:
        return {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.generator.set_state(state["generator"])
