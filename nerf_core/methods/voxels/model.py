"""A grid of density and spherical-harmonic colour, trained directly, coarse to fine: fast on a plain CPU.

Every vertex of the occupied cells holds a raw density s, for each colour channel the four coefficients k of spherical
harmonics up to degree 1, and a vector g of gloss. They are interpolated trilinearly between vertices. Then
σ = softplus(s + bias) and c(d) = sigmoid(Σ_b k_b Y_b(d) + (g · d)²), and volume rendering gives the pixel (NeRF
Eq. 3). There is no network: a sample reads 8 rows, and its gradient changes the same 8. Plenoxels (arXiv:2112.05131)
and DVGO (arXiv:2111.11215) are similar; they have no gloss, but harmonics up to degree 2, or a small network.

Pictures show an EMA (exponential moving average) of the rows, in which the noise of single batches averages out (Polyak
and Juditsky 1992).

Training begins with a coarse grid and shrunken photos. At the end of a level, cells that no training pixel needs are
dropped. Those that carry much of a pixel are divided for the next level, and thin haze stays in larger cells. So time
is spent where surfaces are, and the picture is as good as before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.language import phrase
from nerf_core.common.memory import give_back
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.kernels.choice import voxel_kernels
from nerf_core.kernels.voxel_kernels import Adam, March, Traced
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.voxels.coarse_to_fine import (
    Schedule,
    Worth,
    finer_grid,
    first_grid,
    nothing,
    resample,
    resampled_moments,
)
from nerf_core.methods.voxels.config import VoxelConfig
from nerf_core.methods.voxels.old_states import of_today
from nerf_core.methods.voxels.sparse_depths import SparseDepths
from nerf_core.volume.packed import to_trace
from nerf_core.volume.voxel_grid import DENSITY, GLOSS, MOST_CELLS, MOST_SIZES, PARTS, VoxelGrid, colors_of

PIECE = 4096  # rays between two calls of the yield callback: 5 to 15 ms on two cores
TILE = 8192
SMALLEST = 1e-5  # a cell's side as a share of the box: no configuration allows smaller ones
ENOUGH = 400_000  # training pixels that are asked which cells they need: a second on two cores
# Or so many for each vertex: with all of 250,000, lego at 100 × 100 learns no better. But at least a quarter of ENOUGH:
# a small object is met by few of them.
PIXELS_A_VERTEX = 4
# A step takes time for its rays, and for Adam over the rows that they touch. On a large grid the rays are the smaller
# part, and in more of them noise averages out.
ROWS_A_RAY = 33
MEMORY = 0.95  # decay of the mean error, per step
DEPTH_SHARE = 16  # so many times fewer rays than a step's go to sparse points: few know more than thousands of pixels
MOST_EPOCHS = 2.0  # rounds beyond so many `epochs` slow no further: photos that agree have more to teach
HARDENING_ROUNDS = 4  # after so many rounds density hardens half as fast
SHORTEST_ROUND = 70  # steps that a round counts for `epochs_density`: few small photos are soon gone through
YOUNG = 4.0  # early on, at step k, average only the last k/YOUNG steps: older rows are outdated


class VoxelModel(Defaults):
    """The voxel grid with its optimiser; see the module."""

    def __init__(self, scene: Scene, config: VoxelConfig, device: torch.device, seed: int) -> None:
        # on a CPU whatever the device, because the fast kernels run on a CPU
        self.config, self.device = config, torch.device("cpu")
        self.scene, self.space = scene, Space.of(scene)
        self.background = torch.tensor(scene.background)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.kernels = voxel_kernels(self.device)
        self.tile = TILE
        self.schedule = Schedule.of(scene, self.space, config)
        self.level = 0
        self.grid = first_grid(self.space, self.schedule.voxel(self.level), config.most_rows)
        # across the view nothing could be learnt: the slope of (g · d)² is 0 there
        away = (self.grid.vertices() - torch.tensor(self.grid.size) / 2) * torch.from_numpy(self.grid.voxel)
        if self.space.kind == "ndc":  # cameras look along −z
            away = torch.tensor([0.0, 0.0, 1.0]).expand_as(away)
        self.grid.rows[:, GLOSS] = config.gloss * functional.normalize(away, dim=-1).float()
        self.moments = torch.zeros(len(self.grid.rows), len(PARTS))  # second ones; there are no first ones
        self.ema_rows = self.grid.rows.clone()
        self.pixels = max(1, scene.photos.counting(scene.trained(config.train_images)))  # to train on; 1: all masked
        self.updates = 0  # Adam's updates
        self.mean_error = 1.0  # mean squared error of the last some 20 steps
        self._before: list[tuple[VoxelGrid, Tensor, Tensor, int, bool]] = []  # what an abandoned step restores
        self.full = False  # whether the grid lacks rows for all the cells that are worth dividing

    @property
    def stage(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  only read
        if not self.full:
            return ""
        return phrase(
            "grid full: only its most seen parts are fine (--set most_rows above {rows:,})", rows=self.config.most_rows
        )

    # ---- training ---------------------------------------------------------------------------------------------------

    def undo(self, step: int) -> Callable[[], None]:
        """Return a function that drops gradients, and restores the coarser grid if the step began a new level."""
        before = self._before = [(self.grid, self.moments, self.ema_rows, self.level, self.full)]

        def back() -> None:
            self.kernels.forget()
            if before:  # else the step was done
                self.grid, self.moments, self.ema_rows, self.level, self.full = before.pop()

        return back

    def draw(self, step: int) -> Draw:
        level = self.schedule.level_at(step)
        c = self.config
        rays = c.first_rays if level == 0 else max(c.rays, min(len(self.grid.rows) // ROWS_A_RAY, c.most_rays))
        return Draw(rays, shrink=self.schedule.levels[level].shrink)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step on the mean squared error.

        Gradients are not divided by the number of rays, so that Adam's ε means the same for every batch size.
        """
        rays, truth = rays.to(self.device), truth.to(self.device)
        c, error, level = self.config, 0.0, self.level
        while self.level < self.schedule.level_at(step):
            self._refine(yield_callback)
        fewer = self._fewer_cells(yield_callback) if self.schedule.drops(step) else None
        if self.level > level or fewer is not None:
            give_back()
        offsets = torch.rand(len(rays), generator=self.generator)
        for start in range(0, len(rays), PIECE):
            part = slice(start, start + PIECE)
            march = self._training_march(offsets[part])
            boxed = self.space.rays(rays[part])
            error += self.kernels.accumulate(self.grid, boxed, truth[part], march)[0]
            yield_callback()
        if c.depth_weight > 0:
            known = self.sparse_depths.some(max(1, len(rays) // DEPTH_SHARE), self.generator)
            march = self._training_march(torch.rand(len(known.t), generator=self.generator))
            self.kernels.accumulate_depths(self.grid, self.space.rays(known.rays), known.t, march)
        self.updates += 1
        slower, slower_density = self._slower(step)
        correction2 = 1 / (1 - c.keep_square**self.updates)
        ema_rate = max(1 - c.average, YOUNG / (YOUNG + self.updates - 1))
        self.kernels.update(
            self.grid, self.moments, self.ema_rows,
            Adam(
                c.rate_color * slower, c.rate_view * slower, c.rate_gloss * slower,
                c.rate_density * slower_density,
                c.keep_square, correction2, c.epsilon, c.least_square, ema_rate, self._harden(step), c.bias,
            ),
        )  # fmt: skip
        if fewer is not None:
            self._take(*fewer)
        self._before.clear()  # frees what the step could have been undone with
        if self.level > level or fewer is not None:
            give_back()
        mean = error / (3 * len(rays))
        self.mean_error += max(1 - MEMORY, 1 / (step + 1)) * (mean - self.mean_error)
        return mean

    def _slower(self, step: int) -> tuple[float, float]:
        """The factors of the learning rates in a step: of colour and gloss, and of density.

        What photos show in common is learnt in the first rounds through their pixels, and where things are before how
        they look. What photos contradict each other in, such as shadows that move and poses that are not right, is
        learnt after them, and makes new views worse.
        """
        c, rounds = self.config, self._rounds(step)
        falls = falls_density = 1.0
        if c.epochs > 0:
            falls = falls_density = 1 + min(rounds / c.epochs, MOST_EPOCHS) ** 2
        if c.epochs_density > 0:
            rounds = min(rounds, self._last_steps(step) / SHORTEST_ROUND)
            falls_density = 1 + min(rounds / c.epochs_density, 1e6) ** 2  # 1e6: no overflow
        return 1 / (1 + step / c.slowdown) / falls, 1 / (1 + step / c.slowdown_density) / falls_density

    @cached_property
    def sparse_depths(self) -> SparseDepths:
        """Raises UserError if there are none, as for a checkpoint that goes on without its COLMAP model."""
        return SparseDepths.of(self.scene, self.config.train_images)

    @property
    def ema_grid(self) -> VoxelGrid:
        """The grid that pictures show: the EMA of the rows."""
        return replace(self.grid, rows=self.ema_rows)

    def _last_steps(self, step: int) -> int:
        """How many steps of the finest level come before a step."""
        return max(0, step - self.schedule.levels[-1].begin)

    def _rounds(self, step: int) -> float:
        """How many rounds through the training pixels these are, of `rays` a step."""
        return self._last_steps(step) * self.config.rays / self.pixels

    def _harden(self, step: int) -> float:
        """How much density hardens in a step.

        Only in the last level: what is opaque in large cells may be wrong, and stays so. Less and less with rounds
        through the photos: pictures lose by it to the end, and depth gains most at first.
        """
        if self.level < len(self.schedule.levels) - 1:
            return 0.0
        return self.config.harden / (1 + (self._rounds(step) / HARDENING_ROUNDS) ** 2)

    def _march(self, offsets: Tensor) -> March:
        return March(self.config.step, self.config.bias, self.background, offsets)

    def _training_march(self, offsets: Tensor) -> March:
        """How rays are sampled in training. Distortion is measured in t′, or in half the box, folded if unbounded."""
        c, kind = self.config, self.space.kind
        unit = 1.0 if kind == "ndc" else self.space.extent
        left = len(self.schedule.levels) - 1 - self.level  # levels that come
        distortion = c.distortion * c.distortion_before**left
        turn = 0.0 if left else c.turn  # coarse surfaces must turn from cell to cell
        return replace(
            self._march(offsets), smoothness=c.smoothness, smoothness_color=c.smoothness_color, slope=c.slope,
            turn=turn, distortion=distortion, reach=c.reach, unit=unit, folded=kind == "contracted",
            depth=c.depth_weight,
        )  # fmt: skip

    # ---- coarse to fine ---------------------------------------------------------------------------------------------

    def worth(self, yield_callback: Callable[[], None] = nothing) -> Worth:
        """Return what the cells are worth to the training photos.

        Without the cells that are not needed, no pixel changes by more than about `spare`, or `spare_error` of the
        photos' RMS error. See `VoxelKernels.mark`.
        """
        best = second = torch.zeros(len(self.grid.rows), dtype=torch.uint8, device=self.device)
        photos, spare = 0, max(self.config.spare, self.config.spare_error * self.mean_error**0.5)
        for rays in self._training_pixels():
            self.kernels.unmark()
            for start in range(0, len(rays), PIECE):
                part = self.space.rays(rays[start : start + PIECE])
                middle = torch.full((len(part),), 0.5)
                self.kernels.mark(self.ema_grid, part, self._march(middle), spare)
                yield_callback()
            marked = self.kernels.marked(self.ema_grid)
            second = torch.maximum(second, torch.minimum(best, marked))
            best = torch.maximum(best, marked)
            photos += 1
        self.kernels.forget()  # a fine grid's gradients take more than all that is needed from here on
        return Worth.of(self.grid, best, second if photos > 1 else best, self.config.beside, yield_callback)

    def _training_pixels(self) -> Iterator[Rays]:
        """The rays of the training photos' pixels at this level that are not masked, photo after photo.

        One for each cell's width, and at most ENOUGH, or fewer on a small grid: what lies between them is mostly seen
        in other photos.
        """
        scale, _, shrink = self.schedule.levels[self.level]
        views = self.scene.trained(self.config.train_images)
        cameras = [self.scene.views[i].camera.shrunk(shrink) for i in views]
        enough = min(ENOUGH, max(ENOUGH // 4, PIXELS_A_VERTEX * len(self.grid.rows)))
        many = sum(camera.width * camera.height for camera in cameras) / enough
        apart = max(1, round(scale * self.config.pixels / shrink), math.ceil(math.sqrt(many)))
        for n, camera in enumerate(cameras):
            rows, columns = np.mgrid[n % apart : camera.height : apart, n // apart % apart : camera.width : apart]
            pixels = np.stack([columns.ravel(), rows.ravel()], -1)
            if (mask := self.scene.photos.mask(views[n])) is not None:
                middle = np.minimum(pixels * shrink + shrink // 2, [mask.shape[1] - 1, mask.shape[0] - 1])
                pixels = pixels[mask[middle[:, 1], middle[:, 0]]]
            yield camera_rays(camera, self.scene.near, self.scene.far, pixels).to(self.device)

    def _fewer_cells(self, yield_callback: Callable[[], None]) -> tuple[VoxelGrid, Tensor] | None:
        """Return what `VoxelGrid.with_cells` returns for the needed cells; None if there are none.

        A picture of pure background must keep cells that can learn.
        """
        needed = self.worth(yield_callback).needed
        yield_callback()
        return self.grid.with_cells(needed) if needed.any() else None

    def _take(self, fewer: VoxelGrid, kept: Tensor) -> None:
        """Go on with fewer cells, after the step's update, so that nothing needs to be kept to undo it."""
        self.kernels.forget()  # gradients take more than the new rows
        self.grid, self.moments, self.ema_rows = (
            replace(fewer, rows=self.grid.rows[kept]), self.moments[kept], self.ema_rows[kept],
        )  # fmt: skip

    def _refine(self, yield_callback: Callable[[], None]) -> None:
        """Begin the next level: a smaller box around the needed cells, and smaller cells where that shows."""
        worth = self.worth(yield_callback)
        if not worth.needed.any():  # nothing has been learnt yet: keep all cells
            worth = replace(worth, needed=self.grid.occupied)
        grid, full = finer_grid(self.grid, worth, self.config.split, self.config.most_rows, yield_callback)
        resample(self.kernels, self.ema_grid, grid, self.config.bias, yield_callback)
        moments = resampled_moments(self.kernels, self.grid, self.moments, grid, yield_callback)
        self.grid, self.moments, self.ema_rows, self.full = grid, moments, grid.rows.clone(), full
        self.level += 1

    # ---- rendering --------------------------------------------------------------------------------------------------

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        rays = rays.to(self.device)
        return Rendering.cat([self._tile(rays[i : i + TILE]) for i in range(0, len(rays), TILE)])

    def _tile(self, rays: Rays) -> Rendering:
        march = self._march(torch.full((len(rays),), 0.5))
        return self.space.rendering(rays, self.kernels.render(self.ema_grid, self.space.rays(rays), march))

    def trace(self, rays: Rays) -> Trace:
        rays = rays.to(self.device)
        found = self.traced(rays, torch.full((len(rays),), 0.5))
        return to_trace("voxels", self.space, rays, found, self.tau(found), found.rgb, found.pixel)

    def traced(self, rays: Rays, offsets: Tensor) -> Traced:
        """Return the samples of `rays`. The first lies `offsets` (R,) of a step behind the box's front."""
        return self.kernels.trace(self.ema_grid, self.space.rays(rays), self._march(offsets))

    def tau(self, found: Traced) -> Tensor:
        """Return the optical depths (M,) of samples."""
        return functional.softplus(found.raw) * self.config.step

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        rows = self._rows_at(points)[0]
        d = directions.to(self.device, torch.float32)
        return colors_of(rows[:, None], d)

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        """Return the density (P,); it is 0 in empty cells, where rays take no samples."""
        rows, cell = self._rows_at(points)
        unit = float(np.prod(self.grid.voxel) ** (1 / 3)) * self.space.extent * (1 << self.grid.doublings_of(cell))
        sigma = functional.softplus(rows[:, DENSITY] + self.config.bias) / unit
        return torch.where(self.grid.kinds[tuple(cell.unbind(-1))] > 0, sigma, 0)

    def _rows_at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolated rows (P, 16) at world points (P, 3), and their cells (P, 3)."""
        cell, within = self.grid.cells_of(self.space.points(points.to(self.device, torch.float32)))
        return self.ema_grid.interpolate(cell, within), cell

    # ---- state ------------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        """Return a copy whose picture stays the same while training goes on."""
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy._show_only(self.ema_rows.clone())
        return copy

    def _show_only(self, rows: Tensor) -> None:
        """Keep what pictures need, with the given rows."""
        self.grid, self.ema_rows = replace(self.grid, rows=rows), rows
        self.moments, self._before = self.moments[:0].clone(), []

    def parameters(self) -> list[Tensor]:
        return [self.grid.rows]

    def rest(self) -> None:
        self.kernels.forget()

    def finish(self) -> None:
        """End training: free everything that pictures do not need."""
        self._show_only(self.ema_rows)
        self.kernels.forget()

    def grid_state(self) -> dict[str, Tensor]:
        """Return the tensors that pictures need, by name."""
        return {f"grid.{k}": v for k, v in self.grid.state().items()}

    def state(self) -> dict[str, Tensor]:
        numbers = {"level": self.level, "updates": self.updates, "error": self.mean_error, "full": self.full}
        return (
            self.grid_state()
            | {k: torch.tensor(v, dtype=torch.float64 if k == "error" else None) for k, v in numbers.items()}
            | {"moments": self.moments, "average": self.ema_rows}
            | {"generator": self.generator.get_state()}
        )

    def load_grid(self, state: Mapping[str, Tensor]) -> None:
        self.grid = self._restored(of_today(state))
        self.ema_rows = self.grid.rows

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
        state = of_today(state)
        grid, moments, level = self._restored(state), state["moments"], int(state["level"])
        average = state["average"]
        fits = moments.shape == (len(grid.rows), len(PARTS)) and average.shape == grid.rows.shape
        if not fits or any(v.dtype != torch.float32 for v in (moments, average)):
            raise ValueError("the optimiser's moments or the rows' average do not fit the voxel grid")
        if "error" in state:
            error = float(state["error"])
        else:  # an earlier version wrote it, which had more levels and forgot the moments with each
            level, error = min(level, len(self.schedule.levels) - 1), 0.0
        if not 0 <= level < len(self.schedule.levels) or int(state["updates"]) < 0 or not 0 <= error < math.inf:
            raise ValueError(
                f"level {level} of {len(self.schedule.levels)}, {int(state['updates'])} updates, an error of {error}"
            )
        further = len(self.schedule.levels) - 1 - level
        if max(grid.size) << further > MOST_CELLS or len(grid.tables) + further > MOST_SIZES:
            raise ValueError(f"the voxel grid has more cells than level {level} can have")
        self.grid, self.moments, self.ema_rows = grid, *(torch.empty_like(v).copy_(v) for v in (moments, average))
        self.level, self.updates, self.mean_error = level, int(state["updates"]), error
        self.full = bool(state.get("full", False))
        self._before = []
        self.generator.set_state(state["generator"])
