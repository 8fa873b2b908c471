"""Methods without what a method may lack."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Defaults, Draw


@dataclass(frozen=True)
class PlainConfig:
    total_steps: int = 10
    train_images: int = 0

    def to_json(self) -> dict[str, Any]:
        return {}


class Plain(Defaults):
    """One colour for all pixels: the mean of the photos."""

    summary: ClassVar[str] = "One colour."
    constants: ClassVar[type[PlainConfig]] = PlainConfig
    tile = 64

    def __init__(self, scene: Scene, config: PlainConfig, device: torch.device, seed: int) -> None:
        self.config, self.device, self.color = config, torch.device("cpu"), torch.zeros(3)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> PlainConfig:
        return PlainConfig()

    @staticmethod
    def restore(config: Mapping[str, Any]) -> PlainConfig:
        return PlainConfig()

    def draw(self, step: int) -> Draw:
        return Draw(16)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        error = float((truth - self.color).square().mean())
        yield_callback()
        self.color = self.color + (truth.mean(0) - self.color) / (step + 1)
        return error

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        one = torch.ones(len(rays))
        return Rendering(self.color.expand(len(rays), 3).clone(), one, one * torch.nan)

    def state(self) -> dict[str, Tensor]:
        return {"color": self.color}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.color = state["color"].clone()

    def parameters(self) -> list[Tensor]:
        return [self.color]


class Sampled(Plain):
    """The same with one opaque sample per ray, but without radiance, density or explanation."""

    def trace(self, rays: Rays) -> Trace:
        one = torch.ones(len(rays), 1)
        samples = Samples("plain", 3 * one, one, 50 * one, one, one, one, self.color.expand(len(rays), 1, 3).clone())
        return Trace(self.render(rays), (samples,))


class Going(Plain):
    """The same with three places that it looks at along each ray; the last is the surface."""

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        return Rendering(self.color.expand(len(rays), 3).clone(), torch.ones(len(rays)), torch.full((len(rays),), 2.5))

    def visited(self, rays: Rays) -> Tensor:
        return torch.tensor([1.0, 30.0, 2.5]).expand(len(rays), 3)


class OfCamera(Plain):
    """A grey that depends on where the camera stands."""

    def facing(self, camera: Camera) -> OfCamera:
        other = copy(self)
        other.color = torch.full((3,), abs(camera.c2w[0, 3]) % 1, dtype=torch.float32)
        return other

    def caption(self, camera: Camera) -> str:
        return "camera at " + " ".join(f"{v:.2f}" for v in camera.c2w[:, 3])
