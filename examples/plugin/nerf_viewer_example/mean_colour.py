"""The mean colour of all photos: the least that a method can be, and the baseline that every other one must beat."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Defaults, Draw


@dataclass(frozen=True)
class MeanConfig:
    rays: int = constant(1024, "rays per step", least=1, most=2**20)
    total_steps: int = constant(100, "steps of the schedule, unless --steps says otherwise", least=1)
    train_images: int = constant(0, "training photos that are used, evenly spread; 0: all")

    def __post_init__(self) -> None:
        check_ranges(self)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@METHODS.register("mean-colour")
class MeanColour(Defaults):
    """It renders and trains. It keeps no samples, so its pixels cannot be opened; the window says so."""

    summary: ClassVar[str] = "One colour for all pixels: the mean of the photos."
    constants: ClassVar[type[MeanConfig]] = MeanConfig
    tile = 4096  # rays that are rendered at once

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> MeanConfig:
        return changed(MeanConfig(), changes, "mean-colour")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> MeanConfig:
        return restored(MeanConfig, config, "mean-colour")

    def __init__(self, scene: Scene, config: MeanConfig, device: torch.device, seed: int) -> None:
        self.config, self.device = config, device
        self.color = torch.zeros(3, device=device)

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Moves the colour to the mean of all rays so far; returns the mean squared error before."""
        yield_callback()  # what this raises abandons the step: nothing has changed yet
        error = float((truth - self.color).square().mean())
        self.color = self.color + (truth.mean(0) - self.color) / (step + 1)
        return error

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        one = torch.ones(len(rays), device=self.device)
        return Rendering(self.color.expand(len(rays), 3).clone(), one, one * torch.nan)

    def state(self) -> dict[str, Tensor]:
        return {"color": self.color}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.color = state["color"].to(self.device, copy=True)

    def parameters(self) -> list[Tensor]:
        return [self.color]
