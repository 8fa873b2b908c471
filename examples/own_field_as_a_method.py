"""A field of your own as a method: a dense grid of density and colour, written with plain torch.

When this file is imported, the method "grid" is registered. Everything that trains, renders and opens pixels then works
with it: examples/train_own_field.py does that. Saved as nerf_core/methods/grid.py, or named as an entry point of your
own package (group "nerf_viewer.methods"), it is in the window's menu and on the command lines too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.methods import METHODS, Defaults, Draw
from nerf_core.methods.adam import adam_state, load_adam
from nerf_core.methods.stages import Stage, absorption_stage, field_stage
from nerf_core.volume.compositing import absorb, composite, expected_depth

CHANNELS = 4  # density, red, green, blue


@dataclass(frozen=True)
class GridConfig:
    """What `nerf-core methods grid` lists and --set changes. The trainer reads the last two."""

    cells: int = constant(64, "vertices along a side of the grid", least=2, most=512)
    samples: int = constant(96, "samples per ray", least=1, most=4096)
    rays: int = constant(1024, "rays per step", least=1, most=2**20)
    learning_rate: float = constant(0.1, "Adam's learning rate")
    total_steps: int = constant(2000, "steps of the schedule, unless --steps says otherwise", least=1)
    train_images: int = constant(0, "training photos that are used, evenly spread; 0: all")

    def __post_init__(self) -> None:
        check_ranges(self)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@METHODS.register("grid")
class GridMethod(Defaults):
    """σ(x) and c(x) are interpolated between the vertices of a grid over the scene's box."""

    summary: ClassVar[str] = "A dense grid of density and colour, in plain torch."
    constants: ClassVar[type[GridConfig]] = GridConfig
    tile = 2048  # rays that are rendered at once

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> GridConfig:
        return changed(GridConfig(), changes, "grid")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> GridConfig:
        return restored(GridConfig, config, "grid")

    def __init__(self, scene: Scene, config: GridConfig, device: torch.device, seed: int) -> None:
        self.config, self.device = config, device
        self.space = Space.of(scene)
        self.low = torch.tensor(self.space.low, dtype=torch.float32, device=device)
        self.high = torch.tensor(self.space.high, dtype=torch.float32, device=device)
        self.background = torch.tensor(scene.background, device=device)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)  # the trainer restores them when a step is abandoned
        self.grid = torch.zeros(1, CHANNELS, *[config.cells] * 3, device=device)
        self.grid[:, 0] = -3.0  # thin fog: it shows where density would help, and hides nothing
        self.grid.requires_grad_()
        self.optimizer = torch.optim.Adam([self.grid], lr=config.learning_rate)

    # ---- the field ----------------------------------------------------------------------------------------------

    def field(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """σ (...) and colour (..., 3) at world points (..., 3)."""
        flat = self.space.points(points.reshape(-1, 3).to(self.device, torch.float32))
        place = (flat - self.low) / (self.high - self.low) * 2 - 1  # [-1, 1] in the box
        values = torch.nn.functional.grid_sample(
            self.grid, place[None, None, None], align_corners=True, padding_mode="zeros"
        )[0, :, 0, 0].T.reshape(*points.shape[:-1], CHANNELS)
        inside = (place.abs() <= 1).all(-1).reshape(points.shape[:-1])
        return torch.nn.functional.softplus(values[..., 0]) * inside, torch.sigmoid(values[..., 1:])

    def _trace(self, rays: Rays, offsets: Tensor | float) -> Trace:
        """S samples in equal stretches of each ray; offsets: (R, S), or one number, in [0, 1] of a stretch."""
        near, far = rays.near[:, None], rays.far[:, None]
        step = (far - near) / self.config.samples
        t = near + (torch.arange(self.config.samples, device=near.device) + offsets) * step
        sigma, rgb = self.field(rays.origins[:, None] + t[..., None] * rays.directions[:, None])
        delta = step.expand_as(t)
        alpha, transmittance, weights = absorb(sigma, delta)
        color, opacity = composite(weights, rgb, self.background)
        samples = Samples("grid", t, delta, sigma, alpha, transmittance, weights, rgb)
        return Trace(Rendering(color, opacity, expected_depth(weights, t)), (samples,))

    # ---- training -----------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        offsets = torch.rand(len(rays), self.config.samples, generator=self.generator).to(self.device)
        self.optimizer.zero_grad(set_to_none=False)
        color = self._trace(rays.to(self.device), offsets).rendering.color
        loss = torch.nn.functional.mse_loss(color, truth.to(self.device))
        loss.backward()
        yield_callback()  # a preview may be drawn here; if it raises, the step is abandoned before it changes a weight
        self.optimizer.step()
        return loss.item()

    # ---- pictures and the microscope ----------------------------------------------------------------------------

    @torch.no_grad()
    def trace(self, rays: Rays) -> Trace:
        return self._trace(rays.to(self.device), 0.5)

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        tiles = [rays[k : k + self.tile] for k in range(0, len(rays), self.tile)]
        return Rendering.cat([self.trace(tile).rendering for tile in tiles])

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        return self.field(points)[1][:, None].expand(-1, len(directions), -1)  # the same towards all directions

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        return self.field(points)[0]

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        samples = self.trace(rays).passes[-1]
        sentence = "The grid's vertices are interpolated at each sample."
        return field_stage(samples, sentence), absorption_stage(samples)

    # ---- checkpoints --------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        other = copy(self)
        other.grid = self.grid.detach().clone()
        return other

    def state(self) -> dict[str, Tensor]:
        return {"grid": self.grid.detach(), "generator": self.generator.get_state()} | adam_state(self.optimizer)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            self.grid.copy_(state["grid"])
        self.generator.set_state(state["generator"].cpu())
        load_adam(self.optimizer, [self.grid], state)

    def parameters(self) -> list[Tensor]:
        return [self.grid]
