"""The paper's NeRF made fast: a voxel grid, the proposal grid, is trained first and places the network's samples.

Network, encoding and volume rendering are those of `nerf_core.methods.nerf.model`. The proposal grid replaces the
paper's coarse network: it takes samples along a ray and keeps those whose weight is above `least`, with their δ. Only
these samples are evaluated by the network. A ray then needs about 3 samples instead of 64 + 192, and a ray that hits
nothing needs none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.language import marked, phrase
from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.choice import packed_kernels
from nerf_core.methods import Draw
from nerf_core.methods.guided.config import GuidedConfig
from nerf_core.methods.mlp.model import MlpModel, Parametrised
from nerf_core.methods.voxels.model import VoxelModel
from nerf_core.volume.packed import Packed, opened

CPU = torch.device("cpu")
TILE = 512  # rays: about 10 ms on two cores
PIECE = 1024  # samples whose gradient is computed at once on a CPU: about 10 ms
# Rows of one evaluation when pictures are drawn. The number is fixed, so that a pixel does not depend on its
# neighbours: the rounding of a matrix product depends on its size.
ROWS = 1024
BLOCK = (
    256  # rows in training are rounded up to a multiple of this, because oneDNN compiles a kernel for every new size
)


class GuidedModel(MlpModel):
    """The guided method; see the module."""

    coarse: ClassVar[str] = marked("the proposal grid's picture")
    alone: ClassVar[bool] = False

    config: GuidedConfig

    def __init__(self, scene: Scene, config: GuidedConfig, device: torch.device, seed: int) -> None:
        super().__init__(scene, config, device, torch.Generator().manual_seed(seed), ("fine",))
        self.guide = VoxelModel(scene, config.guide, device, seed)
        self.generators = self.generator, *self.guide.generators
        self.space = self.guide.space
        self.kernels = packed_kernels(device)
        self.tile = config.tile or TILE
        self.guided = 0  # training steps that the proposal grid has made
        self.samples_per_ray = 8.0  # a running mean

    @property
    def stage(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  only read
        if self.ready:
            return ""
        return phrase(
            "the proposal grid learns, {step:,} of {steps:,} steps: it draws the picture",
            step=self.guided,
            steps=self.config.guide_steps,
        )

    @property
    def born(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]  only read
        return self.config.guide_steps if self.ready else 0

    @property
    def ready(self) -> bool:
        """Whether the proposal grid is trained, so that the network learns and draws the picture."""
        return self.guided >= self.config.guide_steps

    # ---- sampling ---------------------------------------------------------------------------------------------------

    def _placed(self, rays: Rays, offsets: Tensor) -> Packed:
        """The samples that the network evaluates, on its device.

        In contracted space, all weight that the proposal grid finds beyond `far` becomes one sample at `far` whose δ is
        `last_delta`.
        """
        near = rays.to(CPU)
        found = self.guide.traced(near, offsets)
        weight, ray = found.alpha * found.transmittance, found.ray
        inside = found.t <= near.far[ray]
        kept = (inside & (weight > self.config.least)).nonzero()[:, 0]
        ray, t, width = ray[kept], found.t[kept], found.width[kept]
        if self.space.kind == "contracted":
            beyond = torch.zeros(len(rays)).index_add(0, found.ray, torch.where(inside, 0, weight))
            open_ended = (beyond > self.config.least).nonzero()[:, 0]
            ray, order = torch.cat([ray, open_ended]).sort(stable=True)
            t = torch.cat([t, near.far[open_ended]])[order]
            width = torch.cat([width, torch.full((len(open_ended),), self.config.last_delta)])[order]
        row_offsets = torch.searchsorted(ray, torch.arange(len(rays) + 1))
        return Packed(*(v.to(self.device) for v in (row_offsets, t, width)))

    # ---- evaluating -------------------------------------------------------------------------------------------------

    def _inputs(self, p: Parametrised, samples: Packed, rows: int) -> tuple[Tensor, Tensor]:
        """x and γ(d) of all samples, padded to a multiple of `rows`."""
        ray = samples.ray
        x = p.origins[ray] + samples.t[:, None] * p.directions[ray]
        missing = -len(x) % rows
        return functional.pad(x, (0, 0, 0, missing)), functional.pad(p.encoded[ray], (0, 0, 0, missing))

    def _tau(self, raw: Tensor, p: Parametrised, samples: Packed) -> Tensor:
        """Optical depth: ReLU density times δ (NeRF, Eq. 3). It is 0 on rays that do not exist in NDC."""
        ray = samples.ray
        return torch.relu(raw) * samples.width * p.length[ray] * p.exists[ray]

    # ---- training ---------------------------------------------------------------------------------------------------

    def undo(self, step: int) -> Callable[[], None]:
        return super().undo(step) if self.ready else self.guide.undo(step)

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays) if self.ready else self.guide.draw(step)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Train the proposal grid first, then the network: MSE of its colour, Adam with an exponential decay."""
        if not self.ready:
            error = self.guide.train(rays, truth, step, None, yield_callback)
            self.guided += 1
            if self.ready:
                self.guide.finish()
            return error
        self.begin_step(step, steps)
        offsets = torch.rand(len(rays), generator=self.generator)
        piece = max(1, int(PIECE / self.samples_per_ray)) if self.device == CPU else len(rays)
        error, found = 0.0, 0
        for start in range(0, len(rays), piece):
            part = slice(start, start + piece)
            one, count = self._accumulate(rays[part], offsets[part], truth[part], 2 / truth.numel())
            error, found = error + one, found + count
            yield_callback()
        self.optimizer.step()
        self.samples_per_ray = max(1.0, 0.9 * self.samples_per_ray + 0.1 * found / len(rays))
        return error / truth.numel()

    def _accumulate(self, rays: Rays, offsets: Tensor, truth: Tensor, scale: float) -> tuple[float, int]:
        """Add the gradient of `scale`/2 times the squared error. Returns that error and the number of samples."""
        p, samples = self.parametrise(rays), self._placed(rays, offsets)
        count = len(samples.t)
        raw, rgb = (v[:count] for v in self.final(*self._inputs(p, samples, BLOCK)))
        tau = self._tau(raw, p, samples)
        known = tau.detach(), rgb.detach(), samples, self.background
        off = self.kernels.composite(*known)[:, :3] - truth
        if count:
            torch.autograd.backward([tau, rgb], self.kernels.composite_gradient(off * scale, *known))
        return float(off.square().sum()), count

    # ---- rendering --------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _evaluated(self, rays: Rays) -> tuple[Packed, Tensor, Tensor, Tensor]:
        """Evaluate at most a tile of rays. Returns samples, optical depths, colours and the pixels (R, 5)."""
        p, samples = self.parametrise(rays), self._placed(rays, torch.full((len(rays),), 0.5))
        count = len(samples.t)
        x, d = self._inputs(p, samples, ROWS)
        done = [self.final(x[i : i + ROWS], d[i : i + ROWS]) for i in range(0, len(x), ROWS)]
        raw, rgb = (torch.cat(v)[:count] for v in zip(*done, strict=True)) if done else (x[:, 0], x)
        tau = self._tau(raw, p, samples)
        return samples, tau, rgb, self.kernels.composite(tau, rgb, samples, self.background)

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        """Render rays. The picture is the proposal grid's under "coarse", and until the network begins to learn."""
        if quality == "coarse" or not self.ready:
            return self.guide.render(rays).to(self.device)
        rays = rays.to(self.device)
        parts = [rays[i : i + self.tile] for i in range(0, len(rays), self.tile)]
        return Rendering.cat([self.space.rendering(part, self._evaluated(part)[3]) for part in parts])

    def trace(self, rays: Rays) -> Trace:
        """Return the proposal grid's pass, then the network's pass over the samples that it kept."""
        guide = self.guide.trace(rays)
        if not self.ready:
            return guide
        rays = rays.to(self.device)
        samples, tau, rgb, pixel = self._evaluated(rays)
        passes = (*guide.passes, opened("fine", self.space, rays, samples, tau, rgb))
        return Trace(self.space.rendering(rays, pixel), passes)

    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        return super().radiance(points, directions) if self.ready else self.guide.radiance(points, directions)

    def density(self, points: Tensor) -> Tensor:
        return super().density(points) if self.ready else self.guide.density(points)

    # ---- state ------------------------------------------------------------------------------------------------------

    def rest(self) -> None:
        self.guide.rest()

    def frozen(self) -> Self:
        frozen = super().frozen()
        frozen.guide = copy(self.guide) if self.ready else self.guide.frozen()
        return frozen

    def state(self) -> dict[str, Tensor]:
        numbers = {
            "guided": torch.tensor(self.guided),
            "average": torch.tensor(self.samples_per_ray, dtype=torch.float64),
        }
        guide = self.guide.grid_state() if self.ready else self.guide.state()
        return super().state() | numbers | {f"guide.{k}": v for k, v in guide.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        guided, samples = int(state["guided"]), float(state["average"])
        if guided < 0 or not 1 <= samples < 1e6:
            raise ValueError("the guide's progress is not of the kind that is written")
        guide = {k.removeprefix("guide."): v for k, v in state.items() if k.startswith("guide.")}
        if guided >= self.config.guide_steps:
            self.guide.load_grid(guide)
            self.guide.finish()
        else:
            self.guide.load_state(guide)
        super().load_state(state)
        self.guided, self.samples_per_ray = guided, samples
