"""A grid of density and spherical-harmonic colour, trained directly, coarse to fine: fast on a plain CPU.

An "RGBα volume" carried to its end. Every vertex of the occupied cells holds a raw density s and, for each
colour channel, the four coefficients k of spherical harmonics up to degree 1. Between vertices they are interpolated
trilinearly; then σ = softplus(s + bias), c(d) = sigmoid(Σ_b k_b Y_b(d)), and pixels follow from volume rendering (NeRF
Eq. 3). There is no network: a sample touches 8 rows, and so does its gradient. Close relatives are Plenoxels
(arXiv:2112.05131) and DVGO (arXiv:2111.11215).

Pictures show each row's average over its last steps (Polyak and Juditsky 1992), in which the noise of single batches
has settled.

Training begins on a coarse grid and shrunken photos. When a level is done, cells that absorb no light are dropped, the
others are divided, and a finer level begins: time goes where surfaces are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space, pixel_size
from nerf_core.kernels.choice import voxel_kernels
from nerf_core.kernels.voxel_kernels import Adam, March, Traced
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.voxels.config import VoxelConfig
from nerf_core.volume.cells import grow
from nerf_core.volume.packed import to_trace
from nerf_core.volume.voxel_grid import BRICK, DENSITY, ROWS, VoxelGrid, bricks_of

PIECE = 4096  # rays between two calls of the yield callback: some 5 ms on two cores
BRICKS = 2048  # of a new grid between two calls of the yield callback: some 10 ms on two cores
TILE = 8192
SHORTEST_LEVEL = 1.25  # a last level that is less finer than the one before is not worth a refinement
SMALLEST = 1e-5  # a cell's side, as a share of the box: finer than any configuration allows
YOUNG = 4.0  # early in a level, at its step k, average only the last k/YOUNG steps: older rows are outdated
SH = (0.28209479, 0.48860251)  # 1/√4π, √(3/4π): real spherical harmonics of degree 0 and 1


class Level(NamedTuple):
    """scale: how many times larger its cells are than the finest. begin: its first step. shrink: of photos."""

    scale: float
    begin: int
    shrink: int


class VoxelModel(Defaults):
    """See the module."""

    def __init__(self, scene: Scene, config: VoxelConfig, device: torch.device, seed: int) -> None:
        # on a CPU whatever the device: its kernels are made for one
        self.config, self.device = config, torch.device("cpu")
        self.space = Space.of(scene)
        self.background = torch.tensor(scene.background)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.kernels = voxel_kernels(self.device)
        self.tile = TILE
        self.finest = finest_cells(scene, self.space, config)
        self.levels = planned(scene, self.space, config, self.finest)
        self.level = 0
        low, high = self.space.low, self.space.high
        voxel = self.finest * self.levels[0].scale
        while True:
            size = np.ceil((high - low) / voxel - 1e-6).astype(int)
            if ROWS * math.prod(size // BRICK + 1) <= config.most_rows:
                break
            voxel = 1.05 * voxel
        everything = torch.ones(*size.tolist(), dtype=torch.bool)
        self.grid = VoxelGrid.over(low, voxel, everything, self.space.kind == "contracted")
        self.moments = torch.zeros_like(self.grid.rows)
        self.average = self.grid.rows.clone()
        self.updates = 0  # of Adam since the level began

    # ---- training ---------------------------------------------------------------------------------------------------

    def undo(self, step: int) -> Callable[[], None]:
        """Drops gradients; if the step begins with a finer level, also brings the coarser one back."""
        before = self.grid, self.moments, self.average, self.level, self.updates
        seen = self.kernels.seen(self.grid) if self.level < self._level_at(step) else None

        def back() -> None:
            self.kernels.forget()
            if seen is not None:
                self.grid, self.moments, self.average, self.level, self.updates = before
                self.kernels.see(self.grid, seen)

        return back

    def draw(self, step: int) -> Draw:
        level = self._level_at(step)
        return Draw(self.config.first_rays if level == 0 else self.config.rays, shrink=self.levels[level].shrink)

    def _level_at(self, step: int) -> int:
        return max(i for i, level in enumerate(self.levels) if level.begin <= step)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Mean squared error; its gradient is a ray's own, so that Adam's ε means the same for every batch."""
        rays, truth = rays.to(self.device), truth.to(self.device)
        c, error = self.config, 0.0
        while self.level < self._level_at(step):
            self._refine(yield_callback)
        offsets = torch.rand(len(rays), generator=self.generator)
        for start in range(0, len(rays), PIECE):
            part = slice(start, start + PIECE)
            march = self._march(offsets[part], c.smoothness, c.prune)
            boxed = self.space.rays(rays[part])
            error += self.kernels.accumulate(self.grid, boxed, truth[part], march)[0]
            yield_callback()
        self.updates += 1
        since = max(0, step - self.levels[self.level].begin)
        slower = 1 / (1 + since / c.slowdown)
        correction1, correction2 = (1 / (1 - beta**self.updates) for beta in (c.keep, c.keep_square))
        ema_rate = max(1 - c.average, YOUNG / (YOUNG + self.updates - 1))
        self.kernels.update(
            self.grid, self.moments, self.average,
            Adam(
                c.rate_color * slower, c.rate_density * slower, c.keep, c.keep_square,
                correction1, correction2, c.epsilon, ema_rate,
            ),
        )  # fmt: skip
        self._drop_cells(since + 1)
        return error / (3 * len(rays))

    def _drop_cells(self, since: int) -> None:
        """After so many steps of a level. Nothing abandons it half done."""
        if self._half_way(since):
            self._look_anew()  # ignore the first half of a level: it is mostly fog
        elif self.level == len(self.levels) - 1 and since % self.config.prune_every == 0:
            cells = self._filled() & self.grid.occupied
            if cells.any():  # a picture of nothing but background must still be able to change
                self.grid = self.grid.with_cells(cells)
            self._look_anew()

    @property
    def shown(self) -> VoxelGrid:
        """The grid as pictures show it: its rows' average, in which the noise of single steps has settled."""
        return replace(self.grid, rows=self.average)

    def _march(self, offsets: Tensor, smoothness: float = 0.0, threshold: float = 1.0) -> March:
        return March(self.config.step, self.config.bias, self.background, offsets, smoothness, threshold)

    # ---- coarse to fine ---------------------------------------------------------------------------------------------

    def _half_way(self, since: int) -> bool:
        last = self.level == len(self.levels) - 1
        end = self.config.prune_every if last else self.levels[self.level + 1].begin - self.levels[self.level].begin
        return since == end // 2

    def _look_anew(self) -> None:
        self.kernels.see(self.grid, torch.zeros(len(self.grid.rows), dtype=torch.bool, device=self.device))

    def _filled(self) -> Tensor:
        """Cells that were part of some pixel since last asked, and their neighbours."""
        x, y, z = self.grid.size
        return grow(self.grid.dense(self.kernels.seen(self.grid))[:x, :y, :z])

    def _refine(self, yield_callback: Callable[[], None]) -> None:
        """The next level: a smaller box around what is there, divided into smaller cells."""
        old, level = self.grid, self.levels[self.level + 1]
        cells = self._filled() & old.occupied
        if not cells.any():  # nothing learnt yet: begin with everything once more
            cells = old.occupied
        found = cells.nonzero()
        low, high = found.amin(0).numpy(), found.amax(0).numpy() + 1
        origin, far = old.origin + low * old.voxel, old.origin + high * old.voxel
        voxel = self.finest * level.scale
        while True:
            size = np.ceil((far - origin) / voxel - 1e-6).astype(int)
            centres = [torch.from_numpy(((np.arange(n) + 0.5) * voxel[a] + origin[a] - old.origin[a]) / old.voxel[a])
                       for a, n in enumerate(size)]  # fmt: skip
            x, y, z = (v.floor().long().clamp(0, n - 1) for v, n in zip(centres, old.size, strict=True))
            occupied = cells[x][:, y][:, :, z]
            rows = ROWS * int(bricks_of(occupied).sum())
            if rows <= self.config.most_rows:
                break
            voxel = voxel * max(1.05, (rows / self.config.most_rows) ** (1 / 3))
        grid, shown = VoxelGrid.over(origin, voxel, occupied, old.contracted), self.shown
        ratio = float(np.prod(voxel / old.voxel) ** (1 / 3))
        for first in range(0, grid.bricks, BRICKS):
            yield_callback()
            last = min(first + BRICKS, grid.bricks)
            self.kernels.resample(shown, grid, first, last)
            raw = grid.rows[ROWS * first : ROWS * last, DENSITY]
            # density is per cell: a smaller one absorbs as much less
            # 1e-30: what underflows would have no logarithm
            sigma = (functional.softplus(raw + self.config.bias) * ratio).clamp(min=1e-30)
            raw.copy_(sigma + torch.log(-torch.expm1(-sigma)) - self.config.bias)  # softplus, inverted
        self.level += 1
        self.grid, self.moments, self.average, self.updates = grid, torch.zeros_like(grid.rows), grid.rows.clone(), 0

    # ---- rendering --------------------------------------------------------------------------------------------------

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        rays = rays.to(self.device)
        return Rendering.cat([self._tile(rays[i : i + TILE]) for i in range(0, len(rays), TILE)])

    def _tile(self, rays: Rays) -> Rendering:
        march = self._march(torch.full((len(rays),), 0.5))
        return self.space.rendering(rays, self.kernels.render(self.shown, self.space.rays(rays), march))

    def trace(self, rays: Rays) -> Trace:
        rays = rays.to(self.device)
        found = self.traced(rays, torch.full((len(rays),), 0.5))
        return to_trace("voxels", self.space, rays, found, self.tau(found), found.rgb, found.pixel)

    def traced(self, rays: Rays, offsets: Tensor) -> Traced:
        """The samples of `rays`, the first `offsets` (R,) of a step behind where the box begins."""
        return self.kernels.trace(self.shown, self.space.rays(rays), self._march(offsets))

    def tau(self, found: Traced) -> Tensor:
        """Optical depths (M,) of samples."""
        return functional.softplus(found.raw) * self.config.step

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        rows = self._rows_at(points)[0]
        d = directions.to(self.device, torch.float32)
        return torch.sigmoid(torch.einsum("kb,pcb->pkc", self.basis(d), rows[:, :DENSITY].view(-1, 3, 4)))

    @staticmethod
    def basis(d: Tensor) -> Tensor:
        """Y (K, 4) at unit directions (K, 3)."""
        return torch.stack([torch.full_like(d[:, 0], SH[0]), SH[1] * d[:, 1], SH[1] * d[:, 2], SH[1] * d[:, 0]], -1)

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        """0 in cells that no ray looks into."""
        rows, cell = self._rows_at(points)
        unit = float(np.prod(self.grid.voxel) ** (1 / 3)) * self.space.extent
        sigma = functional.softplus(rows[:, DENSITY] + self.config.bias) / unit
        return torch.where(self.grid.occupied[tuple(cell.unbind(-1))], sigma, 0)

    def _rows_at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolated rows (P, 16) at world points (P, 3), and their cells (P, 3)."""
        cell, within = self.grid.cells_of(self.space.points(points.to(self.device, torch.float32)))
        return self.shown.interpolate(cell, within), cell

    # ---- state ------------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        """The same picture, whatever training does meanwhile."""
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy.average = self.average.clone()
        return copy

    def parameters(self) -> list[Tensor]:
        return [self.grid.rows]

    def finish(self) -> None:
        """Give up what only training needs: there will be no more."""
        self.grid = self.shown
        self.average = self.grid.rows
        self.moments, self.kernels = self.moments[:0].clone(), voxel_kernels(self.device)

    def grid_state(self) -> dict[str, Tensor]:
        """What pictures need."""
        return {f"grid.{k}": v for k, v in self.grid.state().items()}

    def state(self) -> dict[str, Tensor]:
        numbers = {"level": self.level, "updates": self.updates}
        return (
            self.grid_state()
            | {k: torch.tensor(v) for k, v in numbers.items()}
            | {"moments": self.moments, "average": self.average}
            | {"seen": self.kernels.seen(self.grid), "generator": self.generator.get_state()}
        )

    def load_grid(self, state: Mapping[str, Tensor]) -> None:
        self.grid = self._restored(state)
        self.average = self.grid.rows

    def _restored(self, state: Mapping[str, Tensor]) -> VoxelGrid:
        grid = VoxelGrid.restored(
            {k.removeprefix("grid."): v.to(self.device) for k, v in state.items() if k.startswith("grid.")},
            self.space.kind == "contracted",
        )
        reach = float((self.space.high - self.space.low).max())
        within = (grid.origin >= self.space.low - reach).all() and (grid.origin <= self.space.high).all()
        if not within or not ((grid.voxel > reach * SMALLEST) & (grid.voxel < reach)).all():
            raise ValueError("the voxel grid does not lie in this scene's box, or its cells have no size")
        return grid

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        grid, moments, level = self._restored(state), state["moments"], int(state["level"])
        average = state["average"]
        if any(v.shape != grid.rows.shape or v.dtype != torch.float32 for v in (moments, average)):
            raise ValueError("the optimiser's moments or the rows' average do not fit the voxel grid")
        if state["seen"].shape != moments.shape[:1] or state["seen"].dtype != torch.bool:
            raise ValueError("what was seen does not fit the voxel grid")
        if not 0 <= level < len(self.levels) or int(state["updates"]) < 0:
            raise ValueError(f"level {level} of {len(self.levels)}, {int(state['updates'])} updates")
        self.grid, self.moments, self.average = grid, *(torch.empty_like(v).copy_(v) for v in (moments, average))
        self.kernels.see(self.grid, state["seen"])
        self.level, self.updates = level, int(state["updates"])
        self.generator.set_state(state["generator"])


def finest_cells(scene: Scene, space: Space, c: VoxelConfig) -> np.ndarray:
    """Sides (3,) of the finest cells in box coordinates: `pixels` pixels of a photo, as seen at the scene's centre."""
    cameras = [scene.views[i].camera for i in scene.split("train")]
    if space.kind == "ndc":
        width, height = (max(getattr(v, side) for v in cameras) for side in ("width", "height"))
        voxel = np.array([2 * c.pixels / width, 2 * c.pixels / height, 2 / c.planes])
    else:
        voxel = np.full(3, c.pixels * pixel_size(scene, space))
    return np.maximum(voxel, (space.high - space.low).max() / c.resolution)


def planned(scene: Scene, space: Space, c: VoxelConfig, finest: np.ndarray) -> list[Level]:
    """From `start` cells to the finest in steps of `growth`, the last one as large as it must be."""
    coarsest = (space.high - space.low).max() / c.start / finest.min()
    count = max(0, math.ceil(math.log(max(coarsest, 1) / SHORTEST_LEVEL) / math.log(c.growth)))
    levels, begin, steps = [], 0, float(c.level_steps)
    for i in range(count + 1):
        scale = max(coarsest, 1.0) ** (1 - i / count) if count else 1.0
        shrink = 2 ** max(0, int(math.log2(max(scale * c.pixels, 1))))
        levels.append(Level(scale, begin, shrink))
        begin += round(steps)
        steps *= c.growth
    return levels
