"""Instant-ngp: a multiresolution hash grid with two small networks, sampled where an occupancy grid allows.

Müller et al. 2022 (arXiv:2201.05989). Features are looked up in L grids of growing resolution. The vertices of a grid
share a table of T rows through a spatial hash, and the networks learn to cope with collisions. Rays need different
numbers of samples, so the samples of all rays are packed into one list. Pictures show an EMA (exponential moving
average) of the weights, in which the noise of single batches averages out (Polyak and Juditsky 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space, pixel_size
from nerf_core.kernels.choice import packed_kernels
from nerf_core.kernels.packed_kernels import BETA1, BETA2, EPSILON, BoxSamples, HashLevels, adam_numbers
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.methods.hash.config import HashConfig
from nerf_core.methods.hash.field import HashField
from nerf_core.methods.hash.fixed_step import FixedStep
from nerf_core.volume.cells import Cells
from nerf_core.volume.compositing import STOP
from nerf_core.volume.occupancy import Occupancy, softened
from nerf_core.volume.packed import to_trace

TILE = 2048  # rays drawn at once on a CPU: about 10 ms
TILE_SAMPLES = 1 << 20  # drawn at once on a GPU: enough to keep it busy, under a gigabyte of activations
PIECE = 1 << 13  # samples between two calls of the yield callback on a CPU: about 10 ms
FIRST_CAPACITY = 1.25  # capacity of a recorded step, in multiples of the samples asked for
FEWEST = 1 << 12  # samples per step below which `halve` refuses
AVERAGE_EVERY = 4  # steps between updates of the EMA: the table is large, and neighbouring steps differ little
FOLLOW = 0.1  # rate of the EMA per update: it spans about 40 steps
YOUNG = 4.0  # at its update k the EMA spans only the last k/YOUNG updates: older weights are outdated


class HashModel(Defaults):
    """The hash method; see the module."""

    def __init__(self, scene: Scene, config: HashConfig, device: torch.device, seed: int) -> None:
        self.config, self.device = config, device
        self.space = Space.of(scene)
        self.background = torch.tensor(scene.background, device=device)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.kernels = packed_kernels(device)
        sides = self.space.high - self.space.low
        voxel = np.full(3, sides.max() / config.cells)
        size = np.maximum(np.ceil(sides / voxel - 1e-6).astype(int), 1)
        everything = torch.ones(*size.tolist(), dtype=torch.bool, device=device)
        cells = Cells.of(self.space.low, voxel, everything, self.space.kind == "contracted")
        self.occupancy = Occupancy(cells, config.empty, config.decay)
        pixel = pixel_size(scene, self.space)
        self.step_cells = float(config.pixels * pixel / voxel[0])
        self.length = config.pixels * pixel  # length of a sample in box coordinates
        finest = config.finest or max(config.coarsest, round(float(sides.max()) / pixel))
        growth = (finest / config.coarsest) ** (1 / max(1, config.levels - 1))
        resolutions = tuple(int(config.coarsest * growth**i + 1e-6) for i in range(config.levels))
        self.field = HashField(
            HashLevels(resolutions), 2**config.log2_rows, config.features, config.hidden, self.kernels
        )
        self.field.initialise(torch.Generator().manual_seed(seed))
        self.field.to(device)
        self.ema_field = deepcopy(self.field).requires_grad_(False)  # pictures show this one
        self.table_gradient = torch.zeros_like(self.field.table)
        self.moments = torch.zeros_like(self.field.table), torch.zeros_like(self.field.table)
        # values that change from step to step are kept in tensors, where a recorded step reads them
        self.rate, self.numbers = torch.tensor(config.learning_rate, device=device), torch.zeros(3, device=device)
        self.optimizer = Adam(
            self.field.networks(), lr=self.rate, betas=(BETA1, BETA2), eps=EPSILON, capturable=device.type == "cuda"
        )
        for parameter in self.field.networks():
            parameter.grad = torch.zeros_like(parameter)
        self.updates = 0
        self.samples_per_ray = 4.0 * config.cells  # a running mean
        self.fixed: FixedStep | None = None

    # ---- training ---------------------------------------------------------------------------------------------------

    def undo(self, step: int) -> Callable[[], None]:
        def clear() -> None:
            self.table_gradient.zero_()

        return clear

    def draw(self, step: int) -> Draw:
        size = self.group.size
        count = int(min(max(size * self.config.samples / self.samples_per_ray, 64), size * self.config.most_rays))
        if self.kernels.fixed_shapes:  # one of a few numbers a process, because each needs its own recording
            own, now = max(count // size, 1), len(self.fixed.rays) if self.fixed is not None else 0
            count = size * (now if 0.4 * own <= now <= 1.1 * own else 2 ** int(math.log2(own)))
        return Draw(count)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: mean squared error, Adam on the networks and on the table's rows that have a gradient."""
        rate = self.config.learning_rate / (1 + step / self.config.slowdown)
        self.numbers.copy_(adam_numbers(rate, self.updates + 1))
        self.rate.fill_(rate)
        for group in self.optimizer.param_groups:  # loading a state replaces the tensor
            group["lr"] = self.rate
        self.optimizer.zero_grad(set_to_none=False)
        batch = len(rays) if self.group.size == 1 else self.draw(step).rays
        own = self.group.part(batch)
        offsets = torch.rand(batch, generator=self.generator)[own.start : own.stop].to(self.device)
        if self.kernels.fixed_shapes:
            fixed = self._fixed(len(rays), batch)
            error, found = fixed(self.occupancy.cells, self.space.rays(rays), offsets, truth)
        else:
            error, found = self._pieces(rays, offsets, truth, 2 / (3 * batch), yield_callback)
        if self.group.size > 1:
            error, found = self._added(error, found)
        if self.group.size > 1 or not self.kernels.fixed_shapes:
            self._update()
        self.updates += 1
        if self.updates % AVERAGE_EVERY == 0:
            self._update_ema(self.updates // AVERAGE_EVERY)
        self.samples_per_ray = max(1.0, 0.9 * self.samples_per_ray + 0.1 * found / batch)
        if self.updates % self.config.update_every == 0:
            self._update_occupancy()
        return error / (3 * batch)

    def _added(self, error: float, found: int) -> tuple[float, int]:
        """Add up the gradients of all processes, and return the sums of their errors and numbers of samples."""
        numbers = torch.tensor([error, found], dtype=torch.float64)
        self.group.add([numbers])
        self.group.add([self.table_gradient])
        self.group.add([p.grad for p in self.field.networks() if p.grad is not None])
        return float(numbers[0]), int(numbers[1])

    def _pieces(
        self, rays: Rays, offsets: Tensor, truth: Tensor, scale: float, yield_callback: Callable[[], None]
    ) -> tuple[float, int]:
        """Compute the gradient of all rays in pieces. Returns the summed squared error and the number of samples."""
        error, found = 0.0, 0
        piece = max(1, int((PIECE if self.device.type == "cpu" else self.config.samples) / self.samples_per_ray))
        for start in range(0, len(rays), piece):
            part = slice(start, start + piece)
            one, samples = self._accumulate(rays[part], offsets[part], truth[part], scale)
            error, found = error + one, found + samples
            yield_callback()
        return error, found

    def _fixed(self, rays: int, batch: int) -> FixedStep:
        if self.fixed is None or len(self.fixed.rays) != rays:
            self.fixed = None  # frees its memory first
            # several processes add up their gradients before the update, which is then no part of the recording
            update = self._update if self.group.size == 1 else lambda: None
            self.fixed = FixedStep(
                self.field, self.kernels, self.occupancy.cells, rays, int(FIRST_CAPACITY * self.config.samples),
                self.step_cells, self.length, self.background, self.table_gradient, update, batch,
            )  # fmt: skip
        return self.fixed

    @torch.no_grad()
    def _update_ema(self, move: int) -> None:
        """Move the EMA towards the weights, for the time number `move` (from 1)."""
        share = max(FOLLOW, YOUNG / (YOUNG + move - 1))
        for mean, now in zip(self.ema_field.parameters(), self.field.parameters(), strict=True):
            mean.lerp_(now, share)

    def _update(self) -> None:
        # the table first: if its kernel runs out of memory, nothing has changed yet and the step can be repeated
        self.kernels.adam(self.field.table.detach(), self.table_gradient, self.moments, self.numbers)
        self.optimizer.step()

    def _update_occupancy(self) -> None:
        """Decide anew which cells are occupied.

        The weights have changed by now, so that the step must not be repeated. If memory runs out, the cells stay as
        they are until the next update, and later steps use half the memory. Raises torch.OutOfMemoryError if that is
        not possible.
        """
        whole = self.updates <= self.config.update_every * self.config.warm_updates
        try:
            self.occupancy.update(self._tau, whole, self.generator)
        except torch.OutOfMemoryError:
            if self.group.size > 1:  # the constants must stay the same in all processes, and the weights have changed
                raise UserError("out of device memory: use a smaller step: --set samples") from None
            if not self.halve():
                raise

    def _accumulate(self, rays: Rays, offsets: Tensor, truth: Tensor, scale: float) -> tuple[float, int]:
        """Add the gradient of `scale`/2 times the squared error. Returns that error and the number of samples."""
        samples = self.kernels.march(self.occupancy.cells, self.space.rays(rays), self.step_cells, offsets)
        features = self.field.encode(samples.x)
        with torch.no_grad():  # samples that no light reaches have no gradient: leave them out before the costly part
            lit = self._reached(softened(self.field.geometry(features)[0]) * self.length, samples)
        samples, features = samples.at(lit), features[lit].requires_grad_()
        raw, geometry = self.field.geometry(features)
        rgb = self.field.radiance(geometry, rays.directions[samples.ray])
        tau = softened(raw) * self.length
        known = tau.detach(), rgb.detach(), samples, self.background
        off = self.kernels.composite(*known)[:, :3] - truth
        if len(samples.t):
            torch.autograd.backward([tau, rgb], self.kernels.composite_gradient(off * scale, *known))
            assert features.grad is not None
            self.kernels.encode_gradient(features.grad, self.field.levels, samples.x, self.table_gradient)
        return float(off.square().sum()), len(samples.t)

    @torch.no_grad()
    def _tau(self, x: Tensor) -> Tensor:
        return softened(self.field.geometry(self.field.encode(x))[0]) * self.length

    def _reached(self, tau: Tensor, samples: BoxSamples) -> Tensor:
        """The indices of the samples whose transmittance is above STOP. No colour is evaluated for the others."""
        return (torch.exp(-samples.before(tau)) > STOP).nonzero()[:, 0]

    def halve(self) -> bool:
        if self.config.samples <= FEWEST:
            return False
        self.config, self.fixed = replace(self.config, samples=self.config.samples // 2), None
        return True

    # ---- rendering --------------------------------------------------------------------------------------------------

    @property
    def tile(self) -> int:
        return TILE if self.device.type == "cpu" else int(min(max(TILE_SAMPLES / self.samples_per_ray, 2**10), 2**17))

    @torch.no_grad()
    def _evaluated(self, rays: Rays) -> tuple[BoxSamples, Tensor, Tensor, Tensor]:
        """Evaluate at most a tile of rays. Returns samples, optical depths, colours and the pixels (R, 5)."""
        offsets = torch.full((len(rays),), 0.5, device=self.device)
        samples = self.kernels.march(self.occupancy.cells, self.space.rays(rays), self.step_cells, offsets)
        raw, geometry = self.ema_field.geometry(self.ema_field.encode(samples.x))
        tau, ray = softened(raw) * self.length, samples.ray
        lit = self._reached(tau, samples)
        rgb = torch.zeros(len(tau), 3, device=self.device)
        rgb[lit] = self.ema_field.radiance(geometry[lit], rays.directions[ray[lit]])
        return samples, tau, rgb, self.kernels.composite(tau, rgb, samples, self.background)

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        rays = rays.to(self.device)
        parts = [rays[i : i + self.tile] for i in range(0, len(rays), self.tile)]
        return Rendering.cat([self.space.rendering(part, self._evaluated(part)[3]) for part in parts])

    def trace(self, rays: Rays) -> Trace:
        rays = rays.to(self.device)
        samples, tau, rgb, pixel = self._evaluated(rays)
        return to_trace("hash", self.space, rays, samples, tau, rgb, pixel)

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        _, geometry = self._geometry(points)
        return self.ema_field.colors(geometry, directions.to(self.device, torch.float32))

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        """Return the density in occupied cells, and 0 elsewhere, because rays take no samples there."""
        raw, _ = self._geometry(points)
        cell, _ = self.occupancy.cells.cells_of(self.space.points(points.to(self.device, torch.float32)))
        return torch.where(self.occupancy.cells.kinds[tuple(cell.unbind(-1))] > 0, softened(raw) / self.space.extent, 0)

    def _geometry(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.ema_field.geometry(self.ema_field.encode(self.unit_points(points)))

    def unit_points(self, points: Tensor) -> Tensor:
        """Map world points (P, 3) to the field's coordinates (P, 3) in [0, 1]."""
        box = self.space.points(points.to(self.device, torch.float32))
        cells = self.occupancy.cells
        low, sides = (torch.from_numpy(v).to(box) for v in (cells.origin, cells.voxel * np.array(cells.size)))
        return ((box - low) / sides).clamp(0, 1)

    # ---- state ------------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy.field = copy.ema_field = deepcopy(self.ema_field)
        copy.fixed = None
        copy.occupancy = Occupancy(self.occupancy.cells, self.config.empty, self.config.decay)
        return copy

    def parameters(self) -> list[Tensor]:
        return list(self.field.parameters())

    def state(self) -> dict[str, Tensor]:
        state = {f"field.{k}": v for k, v in self.field.state_dict().items()}
        state |= {f"shown.{k}": v for k, v in self.ema_field.state_dict().items()}
        return state | adam_state(self.optimizer) | {
            "table_mean": self.moments[0], "table_square": self.moments[1], "absorbed": self.occupancy.absorbed,
            "occupied": self.occupancy.cells.occupied, "updates": torch.tensor(self.updates),
            "needed": torch.tensor(self.samples_per_ray, dtype=torch.float64), "generator": self.generator.get_state(),
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        fits = {"table_mean": self.moments[0], "table_square": self.moments[1], "absorbed": self.occupancy.absorbed,
                "occupied": self.occupancy.cells.occupied}  # fmt: skip
        for name, own in fits.items():
            if state[name].shape != own.shape or state[name].dtype != own.dtype:
                raise ValueError(f"{name} does not fit")
        updates, needed = int(state["updates"]), float(state["needed"])
        if updates < 0 or not 1 <= needed < 1e9:
            raise ValueError("the progress of training is not of the kind that is written")
        self.fixed = None  # its recording writes to the optimiser's old moments
        self.table_gradient.zero_()
        for own, name in ((self.field, "field"), (self.ema_field, "shown")):
            own.load_state_dict({k: state[f"{name}.{k}"] for k in own.state_dict()})
        load_adam(self.optimizer, self.field.networks(), state)
        for own, name in zip(self.moments, ("table_mean", "table_square"), strict=True):
            own.copy_(state[name])
        self.occupancy.absorbed.copy_(state["absorbed"])
        c = self.occupancy.cells
        self.occupancy.cells = Cells.of(c.origin, c.voxel, state["occupied"].to(self.device, copy=True), c.contracted)
        self.updates, self.samples_per_ray = updates, needed
        self.generator.set_state(state["generator"].cpu())
