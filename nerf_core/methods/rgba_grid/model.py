"""RGBα volume rendering: a dense grid of colour and opacity, composited front to back and optimised directly.

A picture is made as for CT scans long before NeRF (Drebin et al. 1988; Levoy 1988): samples along a ray, each with a
colour and an opacity interpolated from a grid, composited from front to back. Here the grid is not measured but
learnt: the squared error of the pixels is differentiated with respect to its vertices. `volume` has the laws.

The grid has N³ vertices of 4 float32: 16 N³ bytes, 34 MB for N = 128 and 268 MB for N = 256, however little of it is
not empty. Training holds four times as much: the gradient and Adam's two moments are as large. A colour is the same
towards all sides, so highlights and reflections average out.

Three things make it fast; none changes what it is. Training begins with a coarse grid, and the sides double from level
to level. Rays take samples only in cells that hold something. And neighbouring vertices are drawn together a little
(total variation, squared), because a grid this free also learns what only one photo shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Self

import torch
from torch import Tensor

from nerf_core.common.language import phrase
from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.kernels.choice import packed_kernels
from nerf_core.kernels.packed_kernels import BoxSamples, adam_numbers
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.rgba_grid.config import GridConfig
from nerf_core.methods.rgba_grid.volume import (
    ALPHA,
    CHANNELS,
    RGB,
    RgbaVolume,
    corners_of,
    neighbours_of,
    optical_depth,
    roughness,
    zeros_like,
)
from nerf_core.volume.compositing import STOP
from nerf_core.volume.packed import to_trace

TILE = 2048  # rays drawn at once on a CPU: about 10 ms
TILE_CUDA = 1 << 15
PIECE = 1 << 14  # samples between two calls of the yield callback on a CPU: about 10 ms
PIECE_CUDA = 1 << 21
FEWEST = 1 << 12  # samples in a piece below which `halve` refuses
ROWS = 1 << 17  # vertices that are smoothed between two calls of the yield callback: about 10 ms


def nothing() -> None:
    """The default yield callback."""


class GridModel(Defaults):
    """The grid with its optimiser; see the module."""

    def __init__(self, scene: Scene, config: GridConfig, device: torch.device, seed: int) -> None:
        self.config, self.device = config, device
        self.background = torch.tensor(scene.background, device=device)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.kernels = packed_kernels(device)
        cpu = device.type == "cpu"
        self.tile, self.piece = (TILE, PIECE) if cpu else (TILE_CUDA, PIECE_CUDA)
        self.sides = config.sides()
        volume = RgbaVolume.fog(self.sides[0], config.fog, Space.of(scene), device)
        self._begin(0, volume, volume.everything())
        self.samples_per_ray = 2.0 * self.sides[0]  # a running mean

    def _begin(
        self, level: int, volume: RgbaVolume, occupied: Tensor, yield_callback: Callable[[], None] = nothing
    ) -> None:
        """Begin a level, without moments and gradient."""
        self.level, self.volume = level, volume
        self.gradient, *moments = (zeros_like(volume.logits, yield_callback) for _ in range(3))
        self.moments = moments[0], moments[1]
        self.updates = 0  # of this level
        self._use(occupied, yield_callback)

    def _use(self, occupied: Tensor, yield_callback: Callable[[], None]) -> None:
        """Take samples in the occupied cells alone."""
        self.cells = self.volume.cells(occupied)
        yield_callback()
        self.corners = corners_of(occupied, yield_callback)
        parts = []
        for rows in self.corners.split(ROWS):
            parts.append(neighbours_of(rows, self.volume.side))
            yield_callback()
        self.neighbours = torch.cat(parts)

    @property
    def stage(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  only read
        last = len(self.sides) - 1
        if self.level >= last:
            return ""
        return phrase(
            "coarse grid of {side}³ vertices: level {level} of {levels}",
            side=self.volume.side,
            level=self.level + 1,
            levels=last + 1,
        )

    # ---- training ---------------------------------------------------------------------------------------------------

    def undo(self, step: int) -> Callable[[], None]:
        before = dict(self.__dict__)

        def back() -> None:
            self.__dict__.update(before)  # an abandoned step has written into nothing but the gradient
            self.gradient.zero_()

        return back

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: squared error and smoothness, Adam on the vertices of occupied cells."""
        c = self.config
        while self.level < c.level_at(step):
            self._refine(yield_callback)
        if self.updates and self.updates % c.update_every == 0:
            self._use(self.volume.occupied(c.empty, yield_callback), yield_callback)
        rays, truth = rays.to(self.device), truth.to(self.device)
        offsets = torch.rand(len(rays), generator=self.generator).to(self.device)
        error, found = 0.0, 0
        piece = max(1, int(self.piece / self.samples_per_ray))
        for start in range(0, len(rays), piece):
            part = slice(start, start + piece)
            one, samples = self._accumulate(rays[part], offsets[part], truth[part])
            error, found = error + one, found + samples
            yield_callback()
        if c.smoothness:
            self._smooth(yield_callback)
        self._update(c.learning_rate / (1 + step / c.slowdown))
        self.samples_per_ray = max(1.0, 0.9 * self.samples_per_ray + 0.1 * found / len(rays))
        return error / truth.numel()

    def _accumulate(self, rays: Rays, offsets: Tensor, truth: Tensor) -> tuple[float, int]:
        """Add the gradient of the rays' mean squared errors. Returns the sum of squares and the number of samples.

        It is not divided by the number of rays, so that `smoothness` means the same for every batch size.
        """
        samples, logits, lengths = self._sampled(rays, offsets)
        tau, found = optical_depth(logits[:, ALPHA], lengths), len(lengths)
        lit = (torch.exp(-samples.before(tau)) > STOP).nonzero()[:, 0]  # others have almost no gradient
        samples, logits, lengths, tau = samples.at(lit), logits[lit], lengths[lit], tau[lit]
        colors, alpha = torch.sigmoid(logits[:, RGB]), torch.sigmoid(logits[:, ALPHA])
        known = tau, colors, samples, self.background
        off = self.kernels.composite(*known)[:, :3] - truth
        by_tau, by_rgb = self.kernels.composite_gradient(off * (2 / 3), *known)
        # the derivative of softplus is the sigmoid, and that of the sigmoid c is c (1 − c)
        by_logits = torch.cat([by_rgb * colors * (1 - colors), (by_tau * lengths * alpha)[:, None]], 1)
        into = self.gradient.view(1, -1, CHANNELS)
        self.kernels.encode_gradient(by_logits, self.volume.levels, samples.x, into)
        return float(off.square().sum()), found

    def _smooth(self, yield_callback: Callable[[], None]) -> None:
        """Add the gradient of `smoothness` · Σ (difference of neighbours)² / 2, at vertices that the step touched."""
        flat = self.gradient.view(-1, CHANNELS)
        for rows, neighbours in zip(self.corners.split(ROWS), self.neighbours.split(ROWS), strict=True):
            own = flat.index_select(0, rows)
            touched = (own != 0).any(-1, keepdim=True)
            more = roughness(self.volume.logits, rows, neighbours) * touched
            flat.index_copy_(0, rows, own.add_(more, alpha=self.config.smoothness))
            yield_callback()

    def _update(self, rate: float) -> None:
        """Make one step of Adam, from the first to the last plane with an occupied cell: others have no gradient."""
        self.updates += 1
        plane = self.volume.side**2
        planes = slice(int(self.corners[0]) // plane, int(self.corners[-1]) // plane + 1)
        logits, gradient, *moments = (
            v[planes].view(1, -1, CHANNELS) for v in (self.volume.logits, self.gradient, *self.moments)
        )
        numbers = adam_numbers(rate, self.updates).to(self.device)
        self.kernels.adam(logits, gradient, (moments[0], moments[1]), numbers)

    def _refine(self, yield_callback: Callable[[], None]) -> None:
        volume = self.volume.refined(self.kernels, self.sides[self.level + 1], yield_callback)
        occupied = volume.occupied(self.config.empty, yield_callback)
        self._begin(self.level + 1, volume, occupied, yield_callback)
        self.samples_per_ray *= 2

    def halve(self) -> bool:
        if self.piece <= FEWEST:
            return False
        self.piece //= 2
        self.tile = max(1, self.tile // 2)
        return True

    # ---- rendering --------------------------------------------------------------------------------------------------

    def _sampled(self, rays: Rays, offsets: Tensor) -> tuple[BoxSamples, Tensor, Tensor]:
        """Return the samples of rays, their logits (M, 4), and their lengths δ/h (M,)."""
        boxed = self.volume.space.rays(rays)
        samples = self.kernels.march(self.cells, boxed, self.config.step, offsets)
        logits = self.volume.at(self.kernels, samples.x)
        return samples, logits, self.volume.cells_crossed(boxed, self.config.step)[samples.ray]

    @torch.no_grad()
    def _evaluated(self, rays: Rays) -> tuple[BoxSamples, Tensor, Tensor, Tensor]:
        """Return samples, optical depths, colours, and the pixels (R, 5) that they composite to."""
        samples, logits, lengths = self._sampled(rays, torch.full((len(rays),), 0.5, device=self.device))
        tau, colors = optical_depth(logits[:, ALPHA], lengths), torch.sigmoid(logits[:, RGB])
        return samples, tau, colors, self.kernels.composite(tau, colors, samples, self.background)

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        rays = rays.to(self.device)
        parts = [rays[i : i + self.tile] for i in range(0, len(rays), self.tile)]
        return Rendering.cat([self.volume.space.rendering(part, self._evaluated(part)[3]) for part in parts])

    def trace(self, rays: Rays) -> Trace:
        rays = rays.to(self.device)
        samples, tau, colors, pixel = self._evaluated(rays)
        return to_trace("rgba-grid", self.volume.space, rays, samples, tau, colors, pixel)

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the colours of points; they are the same towards all directions."""
        return torch.sigmoid(self._logits(points)[:, RGB])[:, None].expand(-1, len(directions), -1)

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        """Return σ = −ln(1 − α)/h (P,). It is 0 in empty cells, where rays take no samples."""
        volume = self.volume
        sigma = optical_depth(self._logits(points)[:, ALPHA], 1 / (volume.cell * volume.space.extent))
        cell, _ = self.cells.cells_of(volume.space.points(points.to(self.device, torch.float32)))
        return torch.where(self.cells.kinds[tuple(cell.unbind(-1))] > 0, sigma, 0)

    def _logits(self, points: Tensor) -> Tensor:
        return self.volume.at(self.kernels, self.volume.unit(points.to(self.device, torch.float32)))

    # ---- state ------------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        """Return a copy for pictures. It has a grid of its own, and shares what training alone uses."""
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy.volume = RgbaVolume(self.volume.logits.clone(), self.volume.space)
        return copy

    def parameters(self) -> list[Tensor]:
        return [self.volume.logits]

    def state(self) -> dict[str, Tensor]:
        return {
            "logits": self.volume.logits, "mean": self.moments[0], "square": self.moments[1],
            "occupied": self.cells.occupied, "level": torch.tensor(self.level), "updates": torch.tensor(self.updates),
            "per_ray": torch.tensor(self.samples_per_ray, dtype=torch.float64),
            "generator": self.generator.get_state(),
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        level, updates, per_ray = int(state["level"]), int(state["updates"]), float(state["per_ray"])
        if not 0 <= level < len(self.sides) or updates < 0 or not 1 <= per_ray < 1e9:
            raise ValueError(f"level {level} of {len(self.sides)}, {updates} updates, {per_ray} samples a ray")
        n = self.sides[level]
        vertex = (n, n, n, CHANNELS), torch.float32
        cell = (n - 1, n - 1, n - 1), torch.bool
        shapes = {"logits": vertex, "mean": vertex, "square": vertex, "occupied": cell}
        for name, (shape, kind) in shapes.items():
            if state[name].shape != shape or state[name].dtype != kind:
                raise ValueError(f"{name} does not fit a grid of {n}³ vertices")
        if not bool(state["occupied"].any()):
            raise ValueError("no cell of the grid is occupied")
        logits, mean, square, occupied = (state[name].to(self.device, copy=True) for name in shapes)
        self._begin(level, RgbaVolume(logits.contiguous(), self.volume.space), occupied)
        self.moments = mean.contiguous(), square.contiguous()
        self.updates, self.samples_per_ray = updates, per_ray
        self.generator.set_state(state["generator"].cpu())
