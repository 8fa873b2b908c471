"""The contract of the methods, checked for every registered one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, cast

import numpy as np
import pytest
import torch
from fitting_scenes import fitting

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.cpu_voxels import CpuVoxels
from nerf_core.methods import METHODS, Dense, Explainable, Method, Radiant, Traceable
from nerf_core.methods.guided import model as guided_model
from nerf_core.methods.guided.method import GuidedNerf
from nerf_core.methods.hash import model as hash_model
from nerf_core.methods.rgba_grid import model as grid_model
from nerf_core.methods.stages import BarCode, Stems, Transfer
from nerf_core.methods.voxels import coarse_to_fine
from nerf_core.methods.voxels import model as voxel_model
from nerf_core.methods.voxels.model import VoxelModel
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
# The constants that make a method small enough for a test; a method that needs none is not listed.
SMALL: dict[str, dict[str, str]] = {
    "nerf": {"rays": "32", "coarse_samples": "16", "fine_samples": "16", "depth": "6", "width": "32"},
    "nerf-guided": {"guide_steps": "1", "depth": "6", "width": "32"},
    "hash": {"samples": "2000", "levels": "4", "log2_rows": "10", "cells": "16", "update_every": "2", "hidden": "16"},
    "voxels": {"start": "6", "level_steps": "1", "pixels": "0.5"},
    "rgba-grid": {"side": "10", "coarsest": "6", "level_steps": "2", "update_every": "2"},
    "srn": {"march_steps": "3", "layers": "2", "generator_layers": "2", "width": "16", "hidden": "4", "tile": "32"},
    "mpi": {"references": "3", "planes": "6", "blended": "2"},
    "neural-volumes": {"template": "8", "width": "16", "latent": "4", "warps": "2", "warp_cells": "4", "step": "0.5"},
}
# Batches of about 77 rays, so that a step calls the yield callback only a few times.
FEW_RAYS = {
    "nerf": {"rays": "77"},
    "nerf-guided": {"rays": "77", "guide.first_rays": "77", "guide.rays": "77"},
    "hash": {"most_rays": "77"},
    "voxels": {"first_rays": "77", "rays": "77"},
    "rgba-grid": {"rays": "77"},
    "srn": {"rays": "77", "chunk_rays": "32"},
    "mpi": {"rays": "77", "references": "2"},
    "neural-volumes": {"rays": "77", "template": "4"},
}
# Methods whose samples do not absorb exponentially: α is not 1 − exp(−σδ), but T and w follow from it all the same.
OTHER_LAWS = {"neural-volumes"}
# State that an abandoned step may change: it notes which samples have weight, and notes the same when it is repeated.
NOTED_AGAIN = {"method.seen", "method.guide.seen"}


class Whole(Method, Traceable, Radiant, Dense, Explainable, Protocol):
    """A method with all capabilities, as each built-in one has them."""


MakeMethod = Callable[..., Whole]


@pytest.fixture
def scene(request: pytest.FixtureRequest, scene: Scene, facing: Scene) -> Scene:
    """The ball seen from all around, or from one side for a method that refuses that."""
    return fitting(request, scene, facing)


@pytest.fixture(params=METHODS.names())
def make(request: pytest.FixtureRequest, scene: Scene) -> MakeMethod:
    def build(seed: int = 0, **changes: str) -> Whole:
        kind = METHODS.get(request.param)
        config = kind.configure(scene, "auto", SMALL.get(request.param, {}) | changes, CPU)
        return cast(Whole, kind(scene, config, CPU, seed))

    return build


def require(method: Method, *abilities: type) -> None:
    """Skip the test of a method that lacks an optional member."""
    lacking = [ability.__name__ for ability in abilities if not isinstance(method, ability)]
    if lacking:
        pytest.skip(f"{type(method).__name__} is not {' or '.join(lacking)}, which is optional")


def some_rays(scene: Scene, count: int = 77) -> tuple[Rays, torch.Tensor]:
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    truth = torch.from_numpy(scene.images[0].reshape(-1, 3).astype("float32") / 65535)
    index = torch.randperm(len(rays), generator=torch.Generator().manual_seed(0))[:count]
    return rays[index], truth[index]


def trained(method: Whole, scene: Scene, steps: int = 3) -> Whole:
    for step in range(steps):
        method.train(*some_rays(scene), step, None, lambda: None)
    return method


def test_a_rendering_has_its_shapes_and_ranges(make: MakeMethod, scene: Scene) -> None:
    method = trained(make(), scene)
    drawn = method.render(some_rays(scene)[0])
    assert drawn.color.shape == (77, 3)
    assert drawn.opacity.shape == drawn.depth.shape == (77,)
    assert drawn.color.dtype == drawn.depth.dtype == torch.float32
    assert ((drawn.color >= -1e-5) & (drawn.color <= 1 + 1e-5)).all()
    assert ((drawn.opacity >= 0) & (drawn.opacity <= 1 + 1e-5)).all()
    hit = ~drawn.depth.isnan()
    assert ((drawn.depth >= 0) | ~hit).all()
    assert not drawn.color.requires_grad


def test_training_gives_finite_losses_and_gradients_and_yields(make: MakeMethod, scene: Scene) -> None:
    method, calls = make(), []
    for step in range(3):
        loss = method.train(*some_rays(scene), step, None, lambda: calls.append(1))
        assert 0 <= loss < 4
    assert len(calls) >= 3
    for parameter in method.parameters():
        assert parameter.isfinite().all()
        assert parameter.grad is None or parameter.grad.isfinite().all()
    assert all(value.isfinite().all() for value in method.state().values())


def test_a_restored_state_goes_on_bit_for_bit(make: MakeMethod, scene: Scene) -> None:
    first, second = trained(make(seed=0), scene), make(seed=9)
    saved = {name: value.clone() for name, value in first.state().items()}
    second.load_state(saved)
    for step in (3, 4):
        losses = [m.train(*some_rays(scene), step, None, lambda: None) for m in (first, second)]
        assert losses[0] == losses[1]
    a, b = first.state(), second.state()
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


def test_a_state_that_was_loaded_is_not_written_into(make: MakeMethod, scene: Scene) -> None:
    method = trained(make(), scene)
    saved = {name: value.clone() for name, value in method.state().items()}
    kept = {name: value.clone() for name, value in saved.items()}
    method.load_state(saved)
    trained(method, scene)
    assert [name for name in saved if not torch.equal(saved[name], kept[name])] == []


def test_a_trace_is_the_rendering_opened_up(make: MakeMethod, scene: Scene) -> None:
    method = trained(make(), scene)
    require(method, Traceable)
    rays = some_rays(scene, min(method.tile, 77))[0]
    trace, drawn = method.trace(rays), method.render(rays)
    assert torch.equal(trace.rendering.color, drawn.color)
    torch.testing.assert_close(trace.rendering.depth, drawn.depth, equal_nan=True, rtol=0, atol=0)
    background = torch.tensor(scene.background)
    last = trace.passes[-1]
    color = (last.weights[..., None] * last.rgb).sum(1) + (1 - last.weights.sum(-1))[:, None] * background
    torch.testing.assert_close(color, drawn.color, atol=1e-5, rtol=0)
    for samples in trace.passes:
        assert (samples.t.diff(dim=-1) >= 0).all()
        if METHODS.name_of(type(method)) not in OTHER_LAWS:
            torch.testing.assert_close(samples.alpha, 1 - torch.exp(-samples.sigma * samples.delta), atol=1e-5, rtol=0)
        torch.testing.assert_close(samples.weights, samples.alpha * samples.transmittance)
        behind = torch.cumprod(1 - samples.alpha.double(), -1)[:, :-1].float()
        torch.testing.assert_close(samples.transmittance[:, 1:], behind, atol=1e-5, rtol=0)


def test_a_pixel_does_not_depend_on_its_neighbours(make: MakeMethod, scene: Scene) -> None:
    method = trained(make(), scene)
    rays = some_rays(scene)[0]
    together = method.render(rays)
    for i in (0, 5, 31, 32, 76):
        alone = method.render(rays[i : i + 1])
        torch.testing.assert_close(alone.color[0], together.color[i], atol=1e-5, rtol=0)
        torch.testing.assert_close(alone.depth[0], together.depth[i], atol=1e-4, rtol=0, equal_nan=True)


def test_rendering_leaves_the_model_as_it_is(make: MakeMethod, scene: Scene) -> None:
    method = trained(make(), scene)
    before = {name: value.clone() for name, value in method.state().items()}
    rays = some_rays(scene, 8)[0]
    for quality in ("coarse", "fine"):
        method.render(rays, quality)
    if isinstance(method, Traceable):
        method.trace(rays)
    if isinstance(method, Radiant):
        method.radiance(torch.zeros(2, 3), torch.eye(3))
    if isinstance(method, Dense):
        method.density(torch.zeros(2, 3))
    if isinstance(method, Explainable):
        method.explain(rays[:1])
    after = method.state()
    assert [name for name in before if not torch.equal(before[name], after[name])] == []


def test_radiance_gives_a_colour_per_direction(make: MakeMethod, scene: Scene) -> None:
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    points = torch.tensor([[0.1, 0.2, 0.3], [0.3, 0.0, -0.2]], dtype=torch.float64)
    method = trained(make(), scene)
    require(method, Radiant)
    rgb = method.radiance(points, directions)
    assert rgb.shape == (2, 50, 3)
    assert ((rgb >= 0) & (rgb <= 1)).all()
    torch.testing.assert_close(rgb[1], method.radiance(points[1:], directions)[0], rtol=1e-4, atol=1e-5)


def test_density_is_that_of_the_samples(make: MakeMethod, scene: Scene) -> None:
    method, (rays, _) = trained(make(), scene, 6), some_rays(scene, 20)
    require(method, Traceable, Dense)
    last = method.trace(rays).passes[-1]
    for ray in range(len(rays)):
        count = last.t.shape[1] if last.count is None else int(last.count[ray])
        points = rays.origins[ray] + last.t[ray, :count, None].to(rays.origins) * rays.directions[ray]
        torch.testing.assert_close(method.density(points), last.sigma[ray, :count], rtol=2e-2, atol=2e-2)


def test_a_walk_has_stages_with_finite_values(make: MakeMethod, scene: Scene) -> None:
    method, (rays, _) = trained(make(), scene), some_rays(scene, 3)
    require(method, Explainable)
    for ray in range(3):
        stages = method.explain(rays[ray : ray + 1])
        assert len({s.title for s in stages}) == len(stages) > 0
        for stage in stages:
            assert stage.sentence.endswith((".", "?"))
            for chart in stage.charts:
                for value in chart:
                    if isinstance(value, np.ndarray):
                        assert np.isfinite(value).all(), stage.title


def test_the_walk_of_a_ray_that_meets_nothing_says_so(make: MakeMethod, scene: Scene) -> None:
    method, (rays, _) = trained(make(), scene), some_rays(scene, 1)
    require(method, Traceable, Explainable)
    away = replace(rays, origins=rays.origins + 100, near=rays.near * 0 + 1, far=rays.far * 0 + 2)
    last = method.trace(away).passes[-1]
    titles = [stage.title for stage in method.explain(away)]
    if last.count is None:  # the paper's method places samples along every ray
        assert "α, T and w" in titles
    else:
        assert int(last.count[0]) == 0
        assert titles[-1] == "No samples"
        assert "α, T and w" not in titles


@pytest.mark.parametrize(
    ("preset", "bare", "told"),
    [("complete", False, True), ("no-pe", True, True), ("no-viewdirs", False, False)],
)
def test_the_walk_says_what_the_network_is_given(scene: Scene, preset: str, bare: bool, told: bool) -> None:
    kind = METHODS.get("nerf")
    method = kind(scene, kind.configure(scene, preset, SMALL["nerf"], CPU), CPU, 0)
    assert isinstance(method, Explainable)
    stages = {stage.title: stage for stage in method.explain(some_rays(scene, 1)[0])}
    code = stages["Encoding"]
    assert ("gets bare coordinates" in code.sentence) == bare
    assert isinstance(code.charts[0], BarCode)
    assert ("γ(d)" in code.charts[0].names) == told
    assert len(code.charts[0].values[0]) == (3 if bare else 63)
    assert ("towards the camera" in stages["Density and colour"].sentence) == told
    pdf, transfer = stages["Resampling"].charts
    assert isinstance(pdf, Stems)
    assert isinstance(transfer, Transfer)
    assert pdf.y.sum() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(transfer.cdf[1:], pdf.y.cumsum(), atol=1e-5)
    np.testing.assert_allclose(np.interp(transfer.draws, transfer.edges, transfer.cdf), transfer.u, atol=1e-3)


@pytest.mark.parametrize("name", ["nerf", "nerf-guided"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_pixel_does_not_depend_on_its_neighbours_in_either_precision(scene: Scene, name: str, precision: str) -> None:
    kind = METHODS.get(name)
    config = kind.configure(scene, "auto", SMALL[name] | {"precision": precision}, CPU)
    method = trained(cast(Whole, kind(scene, config, CPU, 0)), scene)
    rays = some_rays(scene)[0]
    together = method.render(rays)
    for i in (0, 31, 76):
        torch.testing.assert_close(method.render(rays[i : i + 1]).color[0], together.color[i], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", METHODS.names())
def test_an_abandoned_step_leaves_the_state_as_it_was(name: str, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The step is abandoned in each call of the yield callback in turn."""
    for module, piece in ((voxel_model, 30), (guided_model, 100), (hash_model, 2000), (grid_model, 300)):
        monkeypatch.setattr(module, "PIECE", piece)
    monkeypatch.setattr(coarse_to_fine, "BRICKS", 20)
    changes = SMALL.get(name, {}) | FEW_RAYS.get(name, {})
    trainer = Trainer(scene, RunSettings(method=name, changes=changes, device="cpu", threads=1))
    calls = 0  # of the yield callback before the step is abandoned

    def interrupt() -> None:
        nonlocal calls
        calls -= 1
        if calls < 0:
            raise KeyboardInterrupt

    for _ in range(8):
        before = {name: value.clone() for name, value in trainer.state().items()}
        through = 0
        while True:
            calls = through
            try:
                trainer.step(interrupt)
                break
            except KeyboardInterrupt:
                through += 1
                after = trainer.state()
                assert [k for k in before if k not in NOTED_AGAIN and not torch.equal(before[k], after[k])] == []
        assert through > 0


@pytest.mark.parametrize("name", METHODS.names())
def test_training_goes_on_after_a_rest_as_if_there_had_been_none(name: str, scene: Scene) -> None:
    changes = SMALL.get(name, {}) | FEW_RAYS.get(name, {})
    resting, other = (
        Trainer(scene, RunSettings(method=name, changes=changes, device="cpu", threads=1)) for _ in range(2)
    )
    for _ in range(4):
        resting.method.rest()
        resting.step()
        other.step()
    state = other.state()
    assert [k for k, value in resting.state().items() if not torch.equal(value, state[k])] == []


@pytest.mark.parametrize("name", ["voxels", "nerf-guided"])
def test_a_rest_frees_the_gradients(name: str, scene: Scene) -> None:
    changes = SMALL[name] | ({"guide_steps": "100"} if name == "nerf-guided" else {})
    trainer = Trainer(scene, RunSettings(method=name, changes=changes, device="cpu", threads=1))
    trainer.step()
    grid = trainer.method.guide if isinstance(trainer.method, GuidedNerf) else trainer.method
    assert isinstance(grid, VoxelModel)
    assert isinstance(grid.kernels, CpuVoxels)
    assert grid.kernels._gradient.size > 0
    trainer.method.rest()
    assert grid.kernels._gradient.size == grid.kernels._touched.size == grid.kernels._marks.size == 0


@pytest.mark.parametrize(
    ("name", "counter"), [("hash", "updates"), ("nerf-guided", "guided"), ("voxels", "level"), ("voxels", "updates")]
)
def test_a_counter_without_end_is_refused(name: str, counter: str, scene: Scene) -> None:
    trainer = Trainer(scene, RunSettings(method=name, changes=SMALL[name], device="cpu", threads=1))
    state = trainer.state()
    assert f"method.{counter}" in state
    with pytest.raises(UserError, match=f"the checkpoint does not fit method {name} .*: made by another version"):
        Trainer.resume(scene, trainer.describe(), state | {f"method.{counter}": torch.tensor(torch.inf)}, "cpu")
