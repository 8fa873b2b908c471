"""The voxel method beyond its kernels: levels, spaces, dropped cells, and what a checkpoint must hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional

from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import BoxRays, Space, contract
from nerf_core.kernels import choice
from nerf_core.kernels.cpu_voxels import CpuVoxels
from nerf_core.kernels.implementations import on_numba
from nerf_core.kernels.torch_voxels import TorchVoxels
from nerf_core.kernels.voxel_kernels import HALVINGS, March, VoxelKernels
from nerf_core.methods.voxels import config as voxel_config
from nerf_core.methods.voxels import model as voxel_model
from nerf_core.methods.voxels.coarse_to_fine import Worth, class_of, finer_grid, planned, resample
from nerf_core.methods.voxels.config import FEW_OF_OBJECT, FEW_OF_PLACE, MANY_PIXELS, VoxelConfig, pixels_along
from nerf_core.methods.voxels.method import Voxels
from nerf_core.probe import open_ray
from nerf_core.rendering.images import render_camera
from nerf_core.training.evaluate import Selection, evaluate
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer, nothing
from nerf_core.volume.cells import blocks, grow, leaps
from nerf_core.volume.voxel_grid import (
    DENSITY,
    GLOSS,
    MOST_CELLS,
    VoxelGrid,
    blocks_of,
    cells_of_each_size,
    colors_of,
    spread,
    vertices_of,
)

CPU = torch.device("cpu")
SMALL = VoxelConfig(rays=512, first_rays=256, start=8, pixels=0.5, level_steps=6)


def run(scene: Scene, steps: int, seed: int = 0, **changes: object) -> Trainer:
    words = {name: str(value) for name, value in changes.items()}
    small = {"rays": "512", "first_rays": "256", "start": "8", "pixels": "0.5", "level_steps": "6"}
    trainer = Trainer(scene, RunSettings(method="voxels", changes=small | words, seed=seed, threads=2))
    for _ in range(steps):
        trainer.step()
    return trainer


SLOW_DENSITY = {"rate_density": 0.6, "slowdown_density": 300}


def forward(scene: Scene) -> Scene:
    """One photo, taken by a camera that looks along −z, in normalised device coordinates."""
    c2w = torch.eye(4, dtype=torch.float64)[:3].numpy()
    views = tuple(replace(view, camera=view.camera.moved(c2w)) for view in scene.views)
    photos = scene.photos.at([0] * len(views))
    return replace(
        scene, views=views, photos=photos, ndc=Ndc(16, 16, scene.views[0].camera.fx, 1.0, 20.0), near=1.0, far=20.0
    )


def around(scene: Scene) -> Scene:
    return replace(scene, synthetic=False)


def of_many_photos(scene: Scene, count: int = FEW_OF_OBJECT) -> Scene:
    """The scene with so many training photos, of which some are the same."""
    train = scene.split("train")
    many = tuple(train[i % len(train)] for i in range(count))
    return replace(scene, splits={**scene.splits, "train": many})


def test_a_room_has_constants_of_its_own(scene: Scene) -> None:
    scene = of_many_photos(scene)
    back = np.diag([-1.0, 1.0, -1.0])
    turned = {i: np.column_stack([c2w[:, :3] @ back, c2w[:, 3]]) for i, c2w in enumerate(scene.poses)}
    place, room = (VoxelConfig.configure(around(s), "auto", {}, CPU) for s in (scene, scene.reposed(turned)))
    assert room.distortion > place.distortion
    assert room.smoothness_color > place.smoothness_color
    for config in place, room:  # the bound, and the rates that go with it, are for objects
        assert (config.rate_color, config.slowdown, config.keep_square, config.least_square) == (0.2, 500, 0.999, 0)
        assert config.reach == 4
    assert (place.rate_density, place.slowdown_density) == (1, 60)
    assert (room.rate_density, room.slowdown_density) == (0.45, 500)  # if it learnt fast at first, walls would be fog
    room_of_few = around(scene.reposed(turned))
    assert VoxelConfig.configure(room_of_few, "auto", {"train_images": "5"}, CPU) == replace(room, train_images=5)
    assert VoxelConfig.configure(scene.reposed(turned), "auto", {}, CPU) == VoxelConfig()  # an object has no walls
    set_by_hand = VoxelConfig.configure(around(scene.reposed(turned)), "auto", {"distortion": "0"}, CPU)
    assert set_by_hand.distortion == 0
    assert (place.slope, room.slope) == (1, 1)
    assert (place.epochs_density, room.epochs_density, room.epochs) == (1.5, 0, 12)
    assert (place.turn, room.turn, place.harden, room.harden) == (0, 0, 0, 0)


@pytest.mark.parametrize("name", ["smoothness", "smoothness_color", "turn", "distortion", "depth_weight"])
def test_a_weight_that_float32_does_not_hold_is_refused(name: str, scene: Scene) -> None:
    with pytest.raises(UserError, match=f"{name}.*at most 1000000"):
        VoxelConfig.configure(scene, "auto", {name: "1e300"}, CPU)


def test_density_learns_slowly_of_few_photos(scene: Scene) -> None:
    many = of_many_photos(scene)
    assert VoxelConfig.configure(many, "auto", {}, CPU) == VoxelConfig()
    one_less = {"train_images": str(FEW_OF_OBJECT - 1)}
    for some, changes in (scene, {}), (many, one_less):
        config = VoxelConfig.configure(some, "auto", changes, CPU)
        assert config.rate_density < VoxelConfig().rate_density
        assert config.slowdown_density > VoxelConfig().slowdown_density
        assert config.reach > VoxelConfig().reach
        assert (config.smoothness, config.smoothness_color, config.slope, config.turn) == (2.5e-6, 3e-7, 1, 0)
        assert config.harden == 0
        assert config.epochs == 0 < VoxelConfig().epochs
        assert config.rate_color == VoxelConfig().rate_color
    assert VoxelConfig.configure(scene, "auto", {"rate_density": "3"}, CPU).rate_density == 3
    few, enough = (VoxelConfig.configure(around(s), "auto", {}, CPU) for s in (scene, many))
    assert (few.rate_density, few.slowdown_density) == (0.2, few.slowdown)
    assert enough == replace(few, rate_density=1, slowdown_density=60, epochs=5, epochs_density=1.5)
    for count, expected in (FEW_OF_PLACE - 1, few), (FEW_OF_PLACE, enough):
        assert VoxelConfig.configure(around(of_many_photos(scene, count)), "auto", {}, CPU) == expected


def test_objects_in_photos_of_many_pixels_take_steps_of_any_length(scene: Scene) -> None:
    scene = of_many_photos(scene)
    wide = replace(
        scene,
        views=tuple(
            replace(v, camera=v.camera.resized(40 * v.camera.width, 40 * v.camera.height)) for v in scene.views
        ),
    )
    assert pixels_along(wide) == pytest.approx(40 * pixels_along(scene))
    assert pixels_along(scene) < MANY_PIXELS < pixels_along(wide)
    centre = (Space.of(scene).low + Space.of(scene).high) / 2
    inside = scene.reposed({i: np.column_stack([c2w[:, :3], centre]) for i, c2w in enumerate(scene.poses)})
    assert pixels_along(inside) > MANY_PIXELS  # no division by a size of 0
    small, large = (VoxelConfig.configure(s, "auto", {}, CPU) for s in (scene, wide))
    assert small == VoxelConfig()
    assert (small.least_square, large.least_square) == (0.25, 0)
    assert large.rate_color < small.rate_color
    assert (large.slowdown_density, large.distortion, large.reach) == (large.slowdown, 5e-3, 4)
    assert (large.smoothness, large.smoothness_color, large.slope, large.turn) == (2.5e-6, 1e-6, 1, 0)
    assert large.harden == 0
    assert VoxelConfig.configure(wide, "auto", {"train_images": "5"}, CPU) == replace(large, train_images=5)
    assert VoxelConfig.configure(wide, "auto", {"least_square": "0.25"}, CPU).least_square == 0.25


# ---- spaces -------------------------------------------------------------------------------------------------------


def test_contraction_keeps_the_cube_and_maps_infinity_to_twice_its_size() -> None:
    inside = torch.rand(50, 3) * 2 - 1
    assert torch.equal(contract(inside), inside)
    far = torch.tensor([[1e9, 0.0, 0.0], [0.0, -4.0, 2.0], [2.0, 2.0, 2.0]])
    torch.testing.assert_close(contract(far), torch.tensor([[2.0, 0, 0], [0, -1.75, 0.875], [1.5, 1.5, 1.5]]))


@pytest.mark.parametrize("place", [around, forward, lambda scene: scene], ids=["contracted", "ndc", "world"])
def test_a_ray_in_the_box_is_the_ray_in_the_world(scene: Scene, place) -> None:
    scene = place(scene)
    space, rays = Space.of(scene), camera_rays(scene.views[0].camera, scene.near, scene.far)
    boxed, t = space.rays(rays), torch.full((len(rays),), 0.6)
    x = boxed.origins + t[:, None] * boxed.directions
    world = rays.origins + space.world_t(rays, t[:, None]) * rays.directions
    torch.testing.assert_close(contract(x) if space.kind == "contracted" else x, space.points(world), atol=1e-4, rtol=0)


# ---- the grid -----------------------------------------------------------------------------------------------------


def test_every_occupied_cell_has_rows_for_its_corners_and_leaps_never_jump_over_one() -> None:
    occupied = torch.rand(13, 9, 18, generator=torch.Generator().manual_seed(0)) < 0.03
    grid = VoxelGrid.over(np.zeros(3), np.ones(3), occupied, contracted=False)
    corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
    cells = occupied.nonzero()
    assert (grid.row_of((cells[:, None] + corners).reshape(-1, 3)) >= 0).all()
    blocks = {tuple(b) for b in (cells // 4).tolist()}
    for block in torch.cartesian_prod(*(torch.arange(n) for n in grid.leap.shape)).tolist():
        nearest = min(max(abs(a - b) for a, b in zip(block, other, strict=True)) for other in blocks)
        assert int(grid.leap[tuple(block)]) == nearest
    assert len(grid.rows) == int(vertices_of(occupied).sum())
    assert torch.equal(grid.row_of(grid.vertices()), torch.arange(len(grid.rows)))


def test_growing_takes_all_neighbours() -> None:
    one = torch.zeros(5, 5, 5, dtype=torch.bool)
    one[2, 2, 2] = True
    assert int(grow(one).sum()) == 27
    assert not leaps(torch.ones(3, 3, 3, dtype=torch.bool)).any()


@pytest.mark.parametrize("kernels", [CpuVoxels(2), TorchVoxels()], ids=["numba", "torch"])
def test_resampling_keeps_a_linear_field(kernels: VoxelKernels) -> None:
    everything = torch.ones(6, 5, 7, dtype=torch.bool)
    grid = VoxelGrid.over(np.array([-1.0, 0, 2]), np.full(3, 0.5), everything, contracted=False)
    slope = torch.tensor([1.0, -2.0, 3.0])
    where = torch.tensor([-1.0, 0, 2]) + grid.vertices() * 0.5
    grid.rows[:, 3] = where @ slope
    everything = torch.ones(8, 6, 9, dtype=torch.bool)
    fine = VoxelGrid.over(np.array([-0.8, 0.3, 2.2]), np.full(3, 0.2), everything, contracted=False)
    kernels.resample(grid, fine, 0, 5)
    kernels.resample(grid, fine, 5, fine.brick_count)
    at = torch.tensor([-0.8, 0.3, 2.2]) + fine.vertices() * 0.2
    inside = (fine.vertices() <= torch.tensor([8, 6, 9])).all(-1)
    torch.testing.assert_close(fine.rows[inside, 3], (at @ slope)[inside], atol=1e-4, rtol=0)


@pytest.mark.parametrize("method", ["voxels", "nerf"])
@pytest.mark.parametrize("place", [around, forward, lambda scene: scene], ids=["contracted", "ndc", "world"])
def test_a_sample_ends_where_the_next_begins_or_before(
    scene: Scene, place: Callable[[Scene], Scene], method: str
) -> None:
    """`until` is world distance, whatever unit δ has."""
    there = place(scene)
    changes = {"start": "12", "level_steps": "1000"} if method == "voxels" else {"depth": "2", "width": "8"}
    trainer = Trainer(there, RunSettings(method=method, changes=changes))
    ray = open_ray(trainer.method, there, there.views[0].camera, (9, 7), 0)
    first = ray.passes[0]
    near_end = first.until[:-1] < 0.9 * ray.far  # under NDC t is clamped at far
    assert near_end.sum() > 5
    np.testing.assert_allclose(first.until[:-1][near_end], first.t[1:][near_end], rtol=1e-3)
    assert (first.until >= first.t).all()


# ---- training -----------------------------------------------------------------------------------------------------


def voxels_of(trainer: Trainer) -> Voxels:
    assert isinstance(trainer.method, Voxels)
    return trainer.method


@pytest.mark.parametrize(
    ("place", "rates", "decibels"),
    [
        (forward, SLOW_DENSITY, 41),
        (lambda scene: scene, SLOW_DENSITY, 41),
        (lambda scene: around(forward(of_many_photos(scene))), {}, 39),  # the constants of many photos
        (of_many_photos, {}, 39),
    ],
    ids=["slow-ndc", "slow-world", "fast-ndc", "fast-world"],
)
def test_a_refinement_changes_no_picture_and_training_goes_on(
    scene: Scene, place: Callable[[Scene], Scene], rates: dict[str, Any], decibels: float
) -> None:
    """39 or 41 dB between the pictures before and after, sampled finely; larger cells keep their rows, bit for bit.

    σ = softplus(s + bias) of halved densities is interpolated a little differently, most where density rises from
    nothing to opaque within one of these large cells, as it does where density learns fast at first.
    """
    scene = place(scene)
    trainer = run(scene, 40, spare_error=0, start=14, pixels=0.4, level_steps=40, **rates)
    method = voxels_of(trainer)
    rays = [camera_rays(view.camera, scene.near, scene.far) for view in scene.views]
    trained, drawn = method.config, replace(method.config, step=0.05)  # it does not matter where such samples lie
    method.config = drawn
    before, old, updates = torch.cat([method.render(r).color for r in rays]), method.ema_grid, method.updates
    method.config = trained
    moments = method.moments.clone()
    method._refine(nothing)
    new = method.grid
    assert np.array_equal(new.voxel, old.voxel / 2)
    method.config = drawn
    after = torch.cat([method.render(r).color for r in rays])
    assert float((after - before).square().mean()) < 10 ** (-decibels / 10)
    assert method.updates == updates
    assert torch.equal(method.ema_rows, new.rows)
    places, d = new.vertices(), new.doublings_of_rows()
    at = torch.from_numpy(np.round((new.origin - old.origin) / new.voxel).astype(int)) + places
    whole = (at % 2 == 0).all(-1) & (at >= 0).all(-1) & (at // 2 <= torch.tensor(old.size)).all(-1)
    row = old.row_of(at // 2)
    kept = whole & (row >= 0) & (d == 1)
    assert kept.any() or len(new.tables) == 1
    assert torch.equal(new.rows[kept], old.rows[row[kept]])
    assert torch.equal(method.moments[kept], moments[row[kept]])
    divided = whole & (row >= 0) & (d == 0)
    assert divided.any()
    torch.testing.assert_close(method.moments[divided], moments[row[divided]] / 64)


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("kernels", [CpuVoxels(2), TorchVoxels()], ids=["numba", "torch"])
def test_cells_that_are_not_divided_keep_the_picture_exactly(kernels: VoxelKernels, contracted: bool) -> None:
    """Cells of three sizes side by side."""
    g = torch.Generator().manual_seed(0)
    kinds = spread(torch.randint(1, 4, (5, 4, 6), generator=g), 2)
    kinds = torch.where(
        kinds == 2, spread(torch.randint(1, 3, tuple(n // 2 for n in kinds.shape), generator=g), 1), kinds
    )
    half = 2.0 if contracted else 1.0
    old = VoxelGrid.of_kinds(np.full(3, -half), 2 * half / np.array(kinds.shape), kinds.to(torch.uint8), contracted)
    old.rows[:] = torch.randn(old.rows.shape, generator=g)
    worth = Worth(
        old.occupied, tuple(torch.zeros_like(one, dtype=torch.uint8) for one in cells_of_each_size(old.kinds))
    )
    new, full = finer_grid(old, worth, 1.0, 10**9)
    assert not full
    assert int(new.kinds.max()) == int(old.kinds.max()) + 1
    resample(kernels, old, new, 0.0, nothing)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=g), dim=-1)
    rays = BoxRays(0.3 * directions.roll(1, 0), directions, directions, torch.zeros(500), torch.full((500,), 5.0))
    march = March(0.7, 0.0, torch.ones(3), torch.zeros(500))  # an offset is a share of the finest step
    a, b = (kernels.render(grid, rays, march) for grid in (old, new))
    # rounding may put a sample that lies on a cell's face on the other side of it
    assert float((a - b).abs().amax(-1).sort().values[-10]) < 1e-3
    assert float((a - b).abs().amax(-1).median()) < 1e-5


def test_cells_with_thin_haze_stay_large_and_the_limit_of_rows_divides_fewer(scene: Scene) -> None:
    method = voxels_of(run(scene, 12))
    method.schedule.levels.extend([method.schedule.levels[-1]] * 3)
    method._refine(nothing)
    assert len(method.grid.tables) > 1
    assert (method.grid.kinds > 1).any()
    method = voxels_of(run(scene, 6))
    assert method.stage == ""
    whole, full = finer_grid(method.grid, method.worth(), 0.05, 10**9)
    assert not full
    fewer, full = finer_grid(method.grid, method.worth(), 0.05, len(whole.rows) - 1)
    assert full
    assert len(fewer.rows) < len(whole.rows)
    assert (fewer.kinds > 0).sum() == (whole.kinds > 0).sum()


def test_a_cell_is_worth_the_class_of_its_weight() -> None:
    """A slab of one cell, seen by a ray with weight α: its mark is `class_of` of that weight."""
    grid = VoxelGrid.over(np.zeros(3), np.ones(3), torch.ones(1, 1, 1, dtype=torch.bool), contracted=False)
    along = torch.tensor([[0.0, 0.0, 1.0]])
    rays = BoxRays(torch.tensor([[0.5, 0.5, -1.0]]), along, along, torch.zeros(1), torch.full((1,), 9.0))
    march = March(1.0, 0.0, torch.zeros(3), torch.full((1,), 0.5))
    for kernels in (CpuVoxels(1), TorchVoxels()):
        for alpha in (0.9, 0.51, 0.5, 0.49, 0.3, 0.25, 0.2, 0.1, 0.06, 0.03, 1e-3):
            grid.rows[:, DENSITY] = float(np.log(np.expm1(-np.log1p(-alpha))))
            weight = float(kernels.trace(grid, rays, march).alpha[0]) / 2  # half of its grey is the background's black
            kernels.unmark()
            kernels.mark(grid, rays, march, 0.0)
            assert int(kernels.marked(grid).max()) == class_of(weight)
    assert class_of(1.0) == 1 + HALVINGS


def test_only_what_two_photos_see_is_divided(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    method = voxels_of(run(scene, 6))
    one, two = (camera_rays(scene.views[i].camera, scene.near, scene.far) for i in scene.split("train")[:2])
    away = replace(one, directions=-one.directions)
    worth = {}
    for name, photos in {"alone": (one, away), "both": (one, two), "same": (one, one)}.items():
        monkeypatch.setattr(method, "_training_pixels", lambda photos=photos: iter(photos))
        worth[name] = method.worth()
    greatest = {name: max(int(cells.max()) for cells in found.of_each) for name, found in worth.items()}
    assert greatest["alone"] == 0
    assert 0 < greatest["both"] <= greatest["same"]
    assert worth["alone"].needed.any()
    grid, _ = finer_grid(method.grid, worth["alone"], 0.1, 10**9)
    assert int(grid.kinds.max()) == 2
    assert not (grid.kinds == 1).any()


def test_distortion_grows_from_level_to_level_and_turns_count_in_the_last(scene: Scene) -> None:
    method = voxels_of(run(scene, 1, start=4, distortion=0.08, distortion_before=0.5, turn=0.3))
    weights, turns = [], []
    for level in range(len(method.schedule.levels)):
        method.level = level
        weights.append(method._training_march(torch.zeros(1)).distortion)
        turns.append(method._training_march(torch.zeros(1)).turn)
        assert method._training_march(torch.zeros(1)).reach == method.config.reach
    assert len(weights) > 1
    assert turns == [0] * (len(turns) - 1) + [0.3]
    assert weights[-1] == 0.08
    assert all(a == b / 2 for a, b in pairwise(weights))


def test_density_hardens_in_the_last_level(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = run(scene, 0, harden=0.6)
    method, seen = voxels_of(trainer), []
    update = method.kernels.update
    monkeypatch.setattr(method.kernels, "update", lambda *given: (seen.append(given[-1]), update(*given)))
    monkeypatch.setattr(voxel_model, "HARDENING_ROUNDS", 0.01)
    begin = method.schedule.levels[-1].begin
    falls = 0.0
    for step in range(begin + 2):
        trainer.step()
        rounds = max(0, step - begin) * method.config.rays / method.pixels
        falls = 1 + (rounds / voxel_model.HARDENING_ROUNDS) ** 2
        assert seen[-1].harden == pytest.approx(0.6 / falls if step >= begin else 0)
        assert seen[-1].bias == method.config.bias
    assert begin > 0
    assert falls > 1.01


def test_a_small_grid_asks_fewer_pixels_but_not_too_few(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for vertices in (8, 125, 1000):
        method = voxels_of(run(scene, 1, start=4, pixels=0.05))
        method.grid = replace(method.grid, rows=method.grid.rows[:1].repeat(vertices, 1))
        monkeypatch.setattr("nerf_core.methods.voxels.model.ENOUGH", 2000)
        method.level = len(method.schedule.levels) - 1
        asked.append(sum(len(rays) for rays in method._training_pixels()))
    assert 0 < asked[0] == asked[1] < asked[2] <= 2000


def test_a_larger_grid_has_more_rays_a_step(scene: Scene) -> None:
    method = voxels_of(run(scene, 2, start=8, level_steps=1, rays=4, most_rays=100, resolution=16))
    assert method.level > 0
    assert method.draw(2).rays == len(method.grid.rows) // 33 > 4
    method.config = replace(method.config, most_rays=7)
    assert method.draw(2).rays == 7
    method.config = replace(method.config, rays=4000)
    assert method.draw(2).rays == 4000


def test_a_grid_of_many_cells_begins_later(scene: Scene) -> None:
    space = Space.of(scene)
    side = float((space.high - space.low).max())

    def begins(cells: int, **changes: float) -> list[int]:
        config = replace(VoxelConfig(start=40), **changes)
        return [level.begin for level in planned(space, config, np.full(3, side / cells))]

    assert begins(640) == [0, 40, 120, 280, 1024]
    assert begins(160) == [0, 40, 120]
    assert begins(640, wait=0.0) == [0, 40, 120, 280, 600]
    assert begins(20) == [0]


def test_a_grid_takes_at_most_a_quarter_of_the_memory(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_config, "machine_memory", lambda: 8 * 10**9)
    for threads, most in ((2, 4_878_048), (16, 1_515_151), (64, 1_515_151)):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert VoxelConfig.configure(scene, "auto", {}, CPU).most_rows == most
        assert VoxelConfig.configure(scene, "auto", {"most_rows": "9999999"}, CPU).most_rows == 9_999_999
    monkeypatch.setattr(voxel_config, "machine_memory", lambda: 10**12)
    assert VoxelConfig.configure(scene, "auto", {}, CPU).most_rows == VoxelConfig().most_rows


def test_a_run_of_an_earlier_version_keeps_its_rays_and_levels() -> None:
    known = {k: v for k, v in VoxelConfig(rays=77).to_json().items() if k not in ("most_rays", "wait")}
    config = VoxelConfig.restore(known)
    assert (config.rays, config.most_rays, config.wait) == (77, 77, 0)


def test_first_moments_that_an_earlier_version_wrote_are_dropped(scene: Scene) -> None:
    assert "keep" not in VoxelConfig.restore(VoxelConfig().to_json() | {"keep": 0.9}).to_json()
    method, fresh = (voxels_of(run(scene, 5)) for _ in range(2))
    older = torch.full_like(method.grid.rows, torch.nan)
    older[:, [14, 15, 13]] = method.moments
    fresh.load_state(method.state() | {"moments": older})
    assert torch.equal(fresh.moments, method.moments)


def test_rows_of_no_cell_that_an_earlier_version_wrote_are_left_out(scene: Scene) -> None:
    """Its bricks had rows for all of their vertices, and some bricks had no cell any more."""
    trainer = run(scene, 12)
    method, fresh = voxels_of(trainer), voxels_of(run(scene, 1))
    method.schedule.levels.extend([method.schedule.levels[-1]] * 3)
    fresh.schedule.levels.extend([fresh.schedule.levels[-1]] * 3)
    method._refine(nothing)
    assert len(method.grid.tables) > 1
    today = method.state()
    state, used = dict(today), []
    del state["grid.sizes"]
    for d, cells in enumerate(cells_of_each_size(method.grid.kinds, len(method.grid.tables))):
        vertices = vertices_of(cells)
        stored = blocks(vertices)
        stored[0, 0, 0] = True
        state[f"grid.bricks.{d}"] = stored
        used.append(blocks_of(vertices, 2)[stored].flatten())
    held = torch.cat(used)
    assert not held.all()
    for name in ("grid.rows", "average", "moments"):
        state[name] = torch.full((len(held), today[name].shape[1]), torch.nan)
        state[name][held] = today[name]
    fresh.load_state(state)
    assert all(torch.equal(value, today[name]) for name, value in fresh.state().items())
    for name, value, text in (
        ("grid.bricks.0", state["grid.bricks.0"] & False, "lacks rows"),
        ("grid.rows", state["grid.rows"][64:], "do not fit its bricks"),
        ("grid.kinds", state["grid.kinds"][0], "not of the kind"),
    ):
        with pytest.raises(ValueError, match=text):
            fresh.load_state(state | {name: value})


def test_a_grid_without_some_cells_keeps_the_rows_of_the_others(scene: Scene) -> None:
    method = voxels_of(run(scene, 12))
    method.schedule.levels.extend([method.schedule.levels[-1]] * 3)
    method._refine(nothing)
    old = method.grid
    old.rows[:] = torch.arange(len(old.rows))[:, None]
    some = spread(torch.rand([n // 8 for n in old.size], generator=torch.Generator().manual_seed(0)) < 0.7, 3)
    some = torch.nn.functional.pad(
        some, [v for n, m in zip(old.size[::-1], some.shape[::-1], strict=True) for v in (0, n - m)]
    )
    grid, kept = old.with_cells(old.occupied & some)
    grid = replace(grid, rows=old.rows[kept])
    assert 0 < len(grid.rows) < len(old.rows)
    for d in range(len(old.tables)):
        at = grid.vertices()[grid.doublings_of_rows() == d] >> d
        assert torch.equal(old.rows[old.row_of(at, d)], grid.rows[grid.row_of(at, d)])


def test_a_stored_grid_that_further_levels_would_make_too_large_is_refused(scene: Scene) -> None:
    method = voxels_of(run(scene, 1, start=4))
    assert len(method.schedule.levels) > 1
    box = method.space.high - method.space.low
    kinds = torch.ones(MOST_CELLS, 4, 4, dtype=torch.uint8)
    grid = VoxelGrid.of_kinds(method.space.low, box / np.array(kinds.shape), kinds, contracted=False)
    state = {name: value for name, value in method.state().items() if not name.startswith("grid.")}
    state |= {f"grid.{name}": value for name, value in grid.state().items()}
    state |= {name: torch.zeros_like(grid.rows) for name in ("moments", "average")}
    with pytest.raises(ValueError, match="more cells than level 0"):
        method.load_state(state)


def test_a_run_of_an_earlier_version_stays_without_gloss(scene: Scene) -> None:
    """Where there is none, its square has no slope."""
    known = {k: v for k, v in VoxelConfig().to_json().items() if k not in ("gloss", "rate_gloss")}
    earlier = VoxelConfig.restore(known)
    assert (earlier.gloss, earlier.rate_gloss) == (0, 0)
    method = voxels_of(run(scene, 30, gloss=0, level_steps=10))
    assert method.level > 0
    assert method.grid.rows[:, :DENSITY].any()
    assert not method.grid.rows[:, GLOSS].any()
    assert not method.ema_rows[:, GLOSS].any()


def test_gloss_makes_new_views_of_a_glossy_ball_better() -> None:
    scene, found = load_scene(None, LoadOptions(downscale=4)), {}
    for gloss in ("0", "0.3"):
        trainer = Trainer(scene, RunSettings(method="voxels", changes={"gloss": gloss}))
        for _ in range(100):
            trainer.step()
        found[gloss] = evaluate(trainer, Selection("test", scene.split("test")[:6]))["mean"]["psnr"]
    assert found["0.3"] > found["0"] + 0.5


def test_gloss_learns_a_highlight_that_harmonics_of_degree_1_cannot_show() -> None:
    """A wall seen from all sides in front of it: a white lobe on grey, half as bright 27° beside its middle."""
    d = functional.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    d[:, 2] = -d[:, 2].abs()
    truth = 0.3 + 0.6 * (d @ functional.normalize(torch.tensor([0.3, 0.2, -1.0]), dim=0)).clamp(min=0)[:, None] ** 6
    errors = {}
    for gloss in (False, True):
        row = torch.zeros(16)
        row[15] = 0.3 * gloss
        row.requires_grad_()
        adam = torch.optim.Adam([row], 0.05)
        for _ in range(400):
            adam.zero_grad()
            (colors_of(row, d) - truth).square().mean().backward()
            assert row.grad is not None
            adam.step()
        errors[gloss] = float((colors_of(row.detach(), d) - truth).square().mean())
    assert errors[True] < 0.5 * errors[False]


def test_dropping_cells_costs_no_pixel_a_level_and_held_out_photos_a_tenth_of_a_decibel(scene: Scene) -> None:
    trainer = run(scene, 60, spare_error=0, split=1e-6)  # cells of one size, whose samples stay where they are
    method = voxels_of(trainer)
    rays = [camera_rays(scene.views[i].camera, scene.near, scene.far) for i in range(len(scene.views))]
    before = [method.render(r).color for r in rays]
    cells = int(method.grid.occupied.sum())
    fewer = method._fewer_cells(nothing)
    assert fewer is not None
    method._take(*fewer)
    assert int(method.grid.occupied.sum()) < cells
    for i, r in enumerate(rays):
        after = method.render(r).color
        if i in scene.split("train"):
            assert float((after - before[i]).abs().max()) < 1 / 255
        else:
            truth = torch.from_numpy(scene.images[i].astype(np.float32) / 65535).view(-1, 3)
            errors = [float((drawn - truth).square().mean()) for drawn in (before[i], after)]
            assert -10 * np.log10(errors[1] / errors[0]) > -0.1


def test_pictures_show_the_ema_of_the_last_steps(scene: Scene) -> None:
    """The EMA spans more steps the longer a level lasts. Pictures and the next finer grid use its rows."""
    trainer = run(scene, 1, average=0.9, level_steps=40)
    method, camera = voxels_of(trainer), scene.views[0].camera
    torch.testing.assert_close(method.ema_rows, method.grid.rows)  # after one step the EMA is that step's rows
    rays = camera_rays(camera, scene.near, scene.far)
    for updates in range(2, 12):
        rows, ema = method.grid.rows.clone(), method.ema_rows.clone()
        trainer.step()
        moved = (method.grid.rows != rows).any(-1)
        follow = max(0.1, 4 / (4 + updates - 1))
        torch.testing.assert_close(method.ema_rows[moved], ema[moved].lerp(method.grid.rows[moved], follow))
        assert torch.equal(method.ema_rows[~moved], ema[~moved])
    drawn = method.render(rays).color
    method.grid.rows.add_(1.0)
    assert torch.equal(method.render(rays).color, drawn)
    method.ema_rows.add_(1.0)
    assert not torch.equal(method.render(rays).color, drawn)


def test_rates_fall_with_every_step_and_adam_goes_on_from_level_to_level(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = run(scene, 0, slowdown=5, slowdown_density=7)
    method, numbers = voxels_of(trainer), []
    update = method.kernels.update
    monkeypatch.setattr(method.kernels, "update", lambda *given: (numbers.append(given[-1]), update(*given)))
    for _ in range(method.schedule.levels[1].begin + 2):
        trainer.step()
    c = method.config
    for step, adam in enumerate(numbers):
        assert adam.rate_density == pytest.approx(c.rate_density / (1 + step / 7))
        assert adam.rate_color == pytest.approx(c.rate_color / (1 + step / 5))
        assert adam.correction2 == pytest.approx(1 / (1 - c.keep_square ** (step + 1)))
        assert adam.least_square == c.least_square > 0


@pytest.mark.parametrize(
    ("epochs", "epochs_density", "rays"),
    [(2.0, 0.0, 100), (0.0, 0.1, 100), (2.0, 0.01, 2), (1e-200, 1e-200, 100)],  # of 2 rays, a round takes 70 steps
)
def test_rates_fall_faster_after_rounds_through_the_photos(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, epochs: float, epochs_density: float, rays: int
) -> None:
    first, other = scene.trained(2)
    size = (scene.views[first].camera.height, scene.views[first].camera.width)
    half = np.arange(math.prod(size)).reshape(size) % 2 == 0  # every second pixel of one photo is masked
    masked = replace(around(scene), photos=scene.photos.masked({first: half}))
    trainer = run(
        masked, 0, slowdown=5, slowdown_density=7, epochs=epochs, epochs_density=epochs_density, train_images=2,
        rays=rays, level_steps=2,
    )  # fmt: skip
    method, rates = voxels_of(trainer), []
    update = method.kernels.update
    monkeypatch.setattr(method.kernels, "update", lambda *given: (rates.append(given[-1][:4]), update(*given)))
    begin = method.schedule.levels[-1].begin
    for _ in range(begin + 4):
        trainer.step()
    c = method.config
    assert first != other
    a_round = int(half.sum() + half.size) / rays
    assert 3 / a_round < 2 * 2.0  # the rates of 2 epochs have not fallen to the end
    assert (a_round > 70) == (rays == 2)
    assert 0 < begin < len(rates) == begin + 4
    for step, found in enumerate(rates):
        steps = max(0, step - begin)
        falls = density = 1 + min(steps / a_round / epochs, 2) ** 2 if epochs else 1.0
        if epochs_density:
            density = 1 + min(steps / max(a_round, 70) / epochs_density, 1e6) ** 2
        given = np.array([c.rate_color, c.rate_view, c.rate_gloss, c.rate_density])
        slower = 1 + step / np.array([5, 5, 5, 7])
        np.testing.assert_allclose(found, given / slower / [falls, falls, falls, density])


def test_a_run_of_an_earlier_version_keeps_its_rates(scene: Scene) -> None:
    today = VoxelConfig.configure(around(scene), "auto", {}, CPU)
    assert today.epochs > 0
    known = {k: v for k, v in today.to_json().items() if k not in ("epochs", "epochs_density")}
    assert VoxelConfig.restore(known) == replace(today, epochs=0, epochs_density=0)
    of_object = VoxelConfig.configure(of_many_photos(scene), "auto", {"slowdown": "123"}, CPU)
    assert of_object.least_square > 0
    known = {k: v for k, v in of_object.to_json().items() if k != "least_square"} | {"rate_color": 0.2}
    assert VoxelConfig.restore(known) == replace(of_object, least_square=0, rate_color=0.2)
    known = {
        k: v
        for k, v in of_object.to_json().items()
        if k not in ("slowdown_density", "reach", "slope", "turn", "harden")
    }
    assert VoxelConfig.restore(known) == replace(of_object, slowdown_density=123, reach=4, slope=1, turn=0, harden=0)
    for hostile in ({k: v for k, v in known.items() if k != "slowdown"}, known | {"slowdown": "fast"}):
        with pytest.raises(UserError, match="slowdown"):
            VoxelConfig.restore(hostile)


def test_cells_are_dropped_in_the_last_level_at_growing_intervals(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = run(scene, 0, prune_every=8)
    method, dropped = voxels_of(trainer), []
    take, given = method._take, []
    monkeypatch.setattr(method, "_take", lambda *fewer: (dropped.append(trainer.step_count), take(*fewer)))
    monkeypatch.setattr(voxel_model, "give_back", lambda: given.append(trainer.step_count))
    begin = method.schedule.levels[-1].begin
    while trainer.step_count < begin + 60:
        trainer.step()
    assert dropped == [begin + 8, begin + 24, begin + 56]
    assert set(given) == {level.begin for level in method.schedule.levels[1:]} | set(dropped)


def test_a_drop_that_fails_leaves_a_model_that_goes_on(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = run(scene, 0, prune_every=8)
    method = voxels_of(trainer)
    while trainer.step_count < method.schedule.levels[-1].begin + 8:
        trainer.step()
    old = method.grid
    with monkeypatch.context() as patch:
        # rows that cannot be taken, as where memory has run out
        patch.setattr(VoxelGrid, "with_cells", lambda grid, needed: (grid, torch.zeros(3, dtype=torch.bool)))
        with pytest.raises(IndexError):
            trainer.step()
    assert method.grid is old
    assert len(old.rows) == len(method.moments) == len(method.ema_rows)
    trainer.step()
    assert len(method.grid.rows) == len(method.moments) == len(method.ema_rows) < len(old.rows)


@pytest.mark.parametrize("change", ["resolution=0", "split=1e308", "pixels=1e300", "step=1e30", "bias=nan", "bias=inf"])
def test_constants_that_no_grid_can_have_are_refused(scene: Scene, change: str) -> None:
    name, value = change.split("=")
    with pytest.raises(UserError, match=f"--set {name}="):
        VoxelConfig.configure(scene, "auto", {name: value}, CPU)


def test_levels_grow_finer_and_empty_space_is_dropped(scene: Scene) -> None:
    trainer = run(scene, 0)
    method = trainer.method
    assert isinstance(method, Voxels)
    scales = [level.scale for level in method.schedule.levels]
    assert len(scales) >= 3
    assert scales == sorted(scales, reverse=True)
    assert scales[-1] == 1
    before = method.grid
    report = None
    while method.level < len(method.schedule.levels) - 1 or trainer.step_count < 120:
        report = trainer.step()
    assert report is not None
    assert report.psnr > 20
    assert method.grid.voxel[0] < before.voxel[0] / 2
    share = float(method.grid.occupied.float().mean()) * np.prod(method.grid.voxel * method.grid.size)
    assert share < 0.7 * np.prod(before.voxel * before.size)


@pytest.mark.parametrize("place", [around, forward])
def test_unbounded_scenes_learn(scene: Scene, place) -> None:
    scene = place(scene)

    def error(trainer: Trainer) -> float:
        color, _ = render_camera(trainer.method, scene.views[0].camera, scene)
        return float(((color - scene.images[0].astype(np.float32) / 65535) ** 2).mean())

    trainer = run(scene, 60)
    assert error(trainer) < 0.3 * error(run(scene, 1))
    assert all(v.isfinite().all() for v in trainer.state().values() if v.is_floating_point())


def test_the_same_seed_gives_the_same_bits_and_another_does_not(scene: Scene) -> None:
    a, b, c = (run(scene, 25, seed).state() for seed in (3, 3, 4))
    assert [name for name in a if not torch.equal(a[name], b[name])] == []
    assert not torch.equal(a["method.grid.rows"], c["method.grid.rows"])


def test_an_abandoned_step_changes_nothing(scene: Scene) -> None:
    """Abandons every step, including those at which a level begins or cells are dropped."""
    trainer, uninterrupted = run(scene, 8, prune_every=7), run(scene, 8, prune_every=7)
    method = trainer.method
    assert isinstance(method, Voxels)

    def interrupt() -> None:
        raise KeyboardInterrupt

    levels, cells = set(), set()
    for _ in range(60):
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                trainer.step(interrupt)
        trainer.step()
        uninterrupted.step()
        levels.add(method.level)
        cells.add((method.level, int(method.grid.occupied.sum())))
    assert len(levels) > 1
    assert len(cells) > len(levels)
    a, b = trainer.state(), uninterrupted.state()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


def test_a_frozen_model_stays(scene: Scene) -> None:
    trainer = run(scene, 30)
    rays = camera_rays(scene.views[5].camera, scene.near, scene.far)
    frozen, before = trainer.frozen_method(), trainer.method.render(rays).color
    for _ in range(30):
        trainer.step()
    assert torch.equal(frozen.render(rays).color, before)
    assert not torch.equal(trainer.method.render(rays).color, before)


def test_rows_never_pass_their_limit(scene: Scene) -> None:
    trainer = run(scene, 60, most_rows=4096)
    method = trainer.method
    assert isinstance(method, Voxels)
    assert method.level == len(method.schedule.levels) - 1
    assert len(method.grid.rows) <= 4096
    assert "--set most_rows above 4,096" in method.stage


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("grid.rows", torch.zeros(64, 16), "do not fit its cells"),
        ("grid.sizes", torch.tensor(99), "not of the kind"),
        ("grid.rows", torch.zeros(64, 16, dtype=torch.float64), "not of the kind"),
        ("grid.voxel", torch.tensor([1.0, 0.0, 1.0]), "not of the kind"),
        ("grid.voxel", torch.full((3,), 1e-30), "cells have no size"),
        ("grid.voxel", torch.full((3,), torch.inf), "does not lie in"),
        ("grid.origin", torch.full((3,), 1e9), "does not lie in"),
        ("updates", torch.tensor(-1), "-1 updates"),
        ("moments", torch.zeros(64, 16), "moments or the rows' average do not fit"),
        ("average", torch.zeros(64, 16), "average do not fit"),
        ("error", torch.tensor(torch.nan, dtype=torch.float64), "an error of nan"),
        ("grid.kinds", torch.full((4, 4, 4), 9, dtype=torch.uint8), "not of the kind"),
        ("grid.kinds", torch.ones(5000, 1, 1, dtype=torch.uint8), "not of the kind"),
        ("level", torch.tensor(99), "level 99"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(scene: Scene, name: str, value: torch.Tensor, text: str) -> None:
    """The compiled loops check no bounds: they would read and write past the end of the table and rows."""
    method = run(scene, 10).method
    with pytest.raises(ValueError, match=text):
        method.load_state(method.state() | {name: value})


def test_cells_without_rows_are_refused_before_they_take_memory(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file with a byte for each cell would otherwise ask for 64 for each vertex."""
    method = run(scene, 10).method
    state = method.state() | {"grid.kinds": torch.ones(64, 64, 64, dtype=torch.uint8), "grid.sizes": torch.tensor(1)}
    monkeypatch.setattr(VoxelGrid, "of_kinds", lambda *_: pytest.fail("it was made"))
    with pytest.raises(ValueError, match="do not fit its cells"):
        method.load_state(state)


def test_without_numba_torch_does_the_same_and_a_note_says_so(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = run(scene, 3)
    monkeypatch.setattr(on_numba, "numba_obstacle", lambda: "numba cannot be imported (gone)")
    plain = run(scene, 3)
    assert isinstance(plain.method, Voxels)
    assert isinstance(plain.method.kernels, TorchVoxels)
    expected = "numba cannot be imported (gone): training runs on plain torch operations, some ten times slower"
    assert choice.note(CPU) == expected
    rays = camera_rays(scene.views[5].camera, scene.near, scene.far)
    a, b = (trainer.method.render(rays).color for trainer in (fast, plain))
    assert float((a - b).abs().mean()) < 2e-3


def test_presets_and_constants_that_do_not_exist_are_named(scene: Scene) -> None:
    with pytest.raises(UserError, match="method voxels has none but auto"):
        VoxelConfig.configure(scene, "complete", {}, CPU)
    with pytest.raises(UserError, match="--set 'wings': method voxels has no such constant"):
        VoxelConfig.configure(scene, "auto", {"wings": "2"}, CPU)
    with pytest.raises(UserError, match=r"--set keep_square=1\.0: must lie in"):
        VoxelConfig.configure(scene, "auto", {"keep_square": "1"}, CPU)


def test_depth_is_where_the_ball_is(scene: Scene) -> None:
    """The fixture's ball has radius 1: seen from the middle of a held-out photo."""
    trainer = run(scene, 150)
    camera = scene.views[5].camera
    middle = camera_rays(camera, scene.near, scene.far, np.array([[8, 8]]))
    drawn = trainer.method.render(middle)
    distance = float(np.linalg.norm(camera.c2w[:, 3]))
    assert float(drawn.opacity[0]) > 0.9
    assert distance - 1.3 < float(drawn.depth[0]) < distance - 0.4


def test_density_is_exported_per_world_unit(scene: Scene) -> None:
    trainer = run(scene, 30)
    method = trainer.method
    assert isinstance(method, Voxels)
    method.ema_rows[:, DENSITY] = 1.0
    samples = method.trace(camera_rays(scene.views[0].camera, scene.near, scene.far)[130:131]).passes[0]
    cell = float(method.grid.voxel[0]) * method.space.extent
    inside = samples.alpha[0] > 0
    expected = torch.nn.functional.softplus(torch.tensor(1.0 + method.config.bias)) / cell
    sigma, d = samples.sigma[0][inside], torch.log2(expected / samples.sigma[0][inside])
    torch.testing.assert_close(d, d.round(), rtol=0, atol=1e-3)  # a cell of twice the side has half of it
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)[130:131]
    points = rays.origins + samples.t[0, inside, None] * rays.directions
    torch.testing.assert_close(method.density(points), sigma, rtol=1e-3, atol=0)
