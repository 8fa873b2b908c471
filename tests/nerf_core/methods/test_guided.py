"""The guided method: the paper's network, evaluated only where a proposal grid of voxels finds density."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.methods.guided.config import GuidedConfig
from nerf_core.methods.guided.method import GuidedNerf
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.methods.nerf.method import Nerf
from nerf_core.methods.voxels.coarse_to_fine import planned
from nerf_core.methods.voxels.config import FEW_OF_OBJECT
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.voxel_grid import GLOSS

CPU = torch.device("cpu")
SMALL = {"depth": "4", "width": "32", "precision": "float32", "rays": "128", "guide_steps": "60"}


def run(scene: Scene, steps: int, **changes: object) -> Trainer:
    words = {name: str(value) for name, value in changes.items()}
    trainer = Trainer(scene, RunSettings(method="nerf-guided", changes=SMALL | words, threads=2))
    for _ in range(steps):
        trainer.step()
    return trainer


def guided(trainer: Trainer) -> GuidedNerf:
    assert isinstance(trainer.method, GuidedNerf)
    return trainer.method


def first_rays(scene: Scene, count: int = 256) -> Rays:
    return camera_rays(scene.views[0].camera, scene.near, scene.far)[:count]


def test_the_network_is_the_papers(scene: Scene) -> None:
    method = GuidedNerf(scene, GuidedConfig(), CPU, 0)
    paper = Nerf(scene, NerfConfig(), CPU, 0).networks["fine"]
    assert [p.shape for p in method.final.parameters()] == [p.shape for p in paper.parameters()]
    assert sum(p.numel() for p in method.parameters()) == 595_844


def test_the_proposal_grid_draws_the_picture_until_it_is_done_and_then_stays(scene: Scene) -> None:
    trainer, rays = run(scene, 60), first_rays(scene)
    method = guided(trainer)
    begun = [p.clone() for p in method.parameters()]
    rows = method.guide.grid.rows.clone()
    assert [p.name for p in method.trace(rays).passes] == ["voxels", "fine"]
    assert method.stage == ""
    trainer.step()
    assert torch.equal(method.guide.grid.rows, rows)
    assert not torch.equal(method.parameters()[0], begun[0])
    early = guided(run(scene, 59))
    assert early.stage == "the proposal grid learns, 59 of 60 steps: it draws the picture"
    assert torch.equal(early.render(rays).color, early.guide.render(rays).color)
    assert [p.name for p in early.trace(rays).passes] == ["voxels"]
    where = torch.zeros(1, 3), torch.eye(3)
    assert torch.equal(early.radiance(*where), early.guide.radiance(*where))
    assert torch.equal(early.density(where[0]), early.guide.density(where[0]))


class _ProposalGridAsNetwork(nn.Module):
    """A network that gives the proposal grid's density, per unit of world distance, and colour at world points."""

    def __init__(self, method: GuidedNerf) -> None:
        super().__init__()
        self.method, self.directions = method, torch.empty(0)

    def encode_directions(self, directions: Tensor) -> Tensor:
        return directions

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        guide = self.method.guide
        rows = guide.grid.interpolate(*guide.grid.cells_of(guide.space.points(x)))
        side = float(guide.grid.voxel[0]) * guide.space.extent  # of a cell, in world units
        sigma = nn.functional.softplus(rows[:, 12] + guide.config.bias) / side
        basis = torch.stack([torch.full_like(d[:, 0], 0.28209479), *(0.48860251 * d[:, a] for a in (1, 2, 0))], -1)
        gloss = (rows[:, GLOSS] * d).sum(-1, keepdim=True) ** 2
        return sigma, torch.sigmoid((rows[:, :12].view(-1, 3, 4) * basis[:, None]).sum(-1) + gloss)


def test_with_the_proposal_grid_as_network_the_picture_is_the_grids(scene: Scene) -> None:
    """The samples' positions, their lengths and the compositing agree.

    They differ only by the culled samples, which weigh at most `least`.
    """
    method = guided(run(scene, 60, least=1e-4))
    rays = first_rays(scene)
    wanted = method.guide.render(rays)
    method.networks = {"fine": _ProposalGridAsNetwork(method)}  # pyright: ignore[reportAttributeAccessIssue]
    drawn = method.render(rays)
    assert float(wanted.opacity.max()) > 0.5
    torch.testing.assert_close(drawn.color, wanted.color, atol=5e-3, rtol=0)
    torch.testing.assert_close(drawn.opacity, wanted.opacity, atol=5e-3, rtol=0)


def test_samples_of_little_weight_are_not_evaluated(scene: Scene) -> None:
    method, rays = guided(run(scene, 60, least=0.05)), first_rays(scene)
    half = torch.full((len(rays),), 0.5)
    found = method.guide.traced(rays, half)
    placed = method._placed(rays, half)
    weight = found.alpha * found.transmittance
    assert 0 < len(placed.t) < len(found.t)
    assert torch.equal(placed.t, found.t[weight > 0.05])
    assert torch.equal(placed.ray, found.ray[weight > 0.05])


def test_everything_beyond_far_is_one_opaque_sample_at_far(scene: Scene) -> None:
    place = replace(scene, synthetic=False, far=scene.near + 1.0)  # unbounded, with a far bound within the content
    method, rays = guided(run(place, 60)), first_rays(place)
    half = torch.full((len(rays),), 0.5)
    found, placed = method.guide.traced(rays, half), method._placed(rays, half)
    weight = found.alpha * found.transmittance
    behind = torch.zeros(len(rays)).index_add(0, found.ray, torch.where(found.t > rays.far[found.ray], weight, 0))
    some = behind > method.config.least
    last = placed.row_offsets[1:][some] - 1
    assert some.any()
    assert torch.equal(placed.t[last], rays.far[some])
    assert (placed.width[last] == method.config.last_delta).all()
    assert (placed.t <= rays.far[placed.ray]).all()
    assert (placed.t.diff()[placed.ray.diff() == 0] >= 0).all()
    assert method.render(rays).color.isfinite().all()


def test_the_gradient_is_the_slope_of_the_loss(scene: Scene) -> None:
    method, rays = guided(run(scene, 90)), first_rays(scene)
    truth, offsets = torch.rand(len(rays), 3, generator=torch.Generator().manual_seed(1)), torch.full((len(rays),), 0.3)
    method.optimizer.zero_grad(set_to_none=False)
    method._accumulate(rays, offsets, truth, 2.0)
    gradients = [p.grad.clone() for p in method.parameters() if p.grad is not None]
    length = sum(float(g.square().sum()) for g in gradients) ** 0.5
    step, values = 1e-3, []
    for sign in (1, -2):  # to one side, then to the other
        with torch.no_grad():
            for parameter, gradient in zip(method.parameters(), gradients, strict=True):
                parameter.add_(gradient, alpha=sign * step / length)
        values.append(method._accumulate(rays, offsets, truth, 0.0)[0])
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(length, rel=0.02)


def test_it_learns_with_few_samples_a_ray(scene: Scene) -> None:
    trainer = run(scene, 61, learning_rate=2e-3)
    losses = [trainer.step().loss for _ in range(150)]
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    assert guided(trainer).samples_per_ray < 16


def test_an_unknown_preset_and_a_useless_threshold_are_refused(scene: Scene) -> None:
    with pytest.raises(UserError, match="nerf-guided has none but auto"):
        GuidedConfig.configure(scene, "quick", {}, CPU)
    with pytest.raises(UserError, match=r"--set least=0\.7"):
        GuidedConfig.configure(scene, "auto", {"least": "0.7"}, CPU)


def test_the_proposal_grids_constants_are_set_checked_and_stored(scene: Scene) -> None:
    config = GuidedConfig.configure(scene, "auto", {"guide.step": "1.5", "rays": "64"}, CPU)
    assert (config.guide.step, config.rays) == (1.5, 64)
    assert GuidedConfig.restore(json.loads(json.dumps(config.to_json()))) == config
    for changes, text in (({"guide.rays": "x"}, "expected a whole number"), ({"guide": "3"}, "no such constant")):
        with pytest.raises(UserError, match=text):
            GuidedConfig.configure(scene, "auto", changes, CPU)
    for broken in ({"guide": 3}, {"guide": {}}, {"guide": config.guide.to_json() | {"rays": "many"}}):
        with pytest.raises(UserError, match="made by another version"):
            GuidedConfig.restore(config.to_json() | broken)


def test_the_proposal_grid_knows_which_photos_it_is_trained_on(scene: Scene) -> None:
    for changes, expected in (
        ({}, 0),
        ({"train_images": "2"}, 2),
        ({"train_images": "2", "guide.train_images": "3"}, 3),
    ):
        assert GuidedConfig.configure(scene, "auto", changes, CPU).guide.train_images == expected
    train = scene.split("train")
    many = replace(scene, splits={**scene.splits, "train": FEW_OF_OBJECT * train})
    for changes, rate in (({}, 3.0), ({"train_images": "5"}, 0.6), ({"guide.train_images": "5"}, 0.6)):
        assert GuidedConfig.configure(many, "auto", changes, CPU).guide.rate_density == rate


def test_the_proposal_grid_of_large_photos_becomes_fine_before_it_is_done(scene: Scene) -> None:
    config, space = GuidedConfig.configure(scene, "auto", {}, CPU), Space.of(scene)
    finest = np.full(3, float((space.high - space.low).max()) / config.guide.resolution)
    assert planned(space, config.guide, finest)[-1].begin < config.guide_steps / 1.5
    waiting = GuidedConfig.configure(scene, "auto", {"guide.wait": "4", "guide.resolution": "640"}, CPU).guide
    assert (waiting.wait, waiting.resolution) == (4, 640)


def test_a_finished_proposal_grid_keeps_no_optimiser(scene: Scene) -> None:
    trainer = run(scene, 59)
    early = trainer.state()
    trainer.step()
    method, done = guided(trainer), trainer.state()
    assert "method.guide.moments" in early
    assert {name for name in done if ".guide." in name} == {name for name in early if ".guide.grid." in name}
    assert not len(method.guide.moments)
    rays, trained = first_rays(scene), trainer.step()
    again = Trainer.resume(scene, trainer.describe(), trainer.state(), "cpu")
    assert torch.equal(guided(again).render(rays).color, method.render(rays).color)
    assert trained.psnr > 0
    trainer.go_to(trainer.describe() | {"step": 59}, early)  # as after a divergence: back to before the grid was done
    assert [trainer.step().step for _ in range(3)] == [60, 61, 62]


def test_a_frozen_proposal_grid_keeps_its_picture(scene: Scene) -> None:
    trainer, rays = run(scene, 20), first_rays(scene)
    frozen = guided(trainer).frozen()
    before = frozen.render(rays).color
    for _ in range(10):
        trainer.step()
    assert torch.equal(frozen.render(rays).color, before)
    assert not torch.equal(guided(trainer).render(rays).color, before)


class _Fog(nn.Module):
    def encode_directions(self, directions: Tensor) -> Tensor:
        return directions

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(x[:, 0], 3.0), torch.zeros_like(x)


def test_under_ndc_density_is_per_length_of_ndc(scene: Scene) -> None:
    """As in the paper's method, δ is a length in normalised device coordinates, however long the ray is there."""
    c2w = torch.eye(4, dtype=torch.float64)[:3].numpy()
    views = tuple(replace(view, camera=view.camera.moved(c2w)) for view in scene.views)
    ndc = Ndc(16, 16, scene.views[0].camera.fx, 1.0, 20.0)
    place = replace(scene, views=views, ndc=ndc, near=1.0, far=20.0)
    method = guided(run(place, 60, least=0.0))
    method.networks = {"fine": _Fog()}  # pyright: ignore[reportAttributeAccessIssue]
    aside = c2w.copy()
    aside[0, 3] = 0.5
    rays = camera_rays(place.views[0].camera.moved(aside), place.near, place.far)
    assert float(ndc.rays(rays.origins, rays.directions)[1].norm(dim=-1).mean()) > 2.05  # 2 along the axis
    fine = method.trace(rays).passes[-1]
    assert fine.count is not None
    real = torch.arange(fine.t.shape[1]) < fine.count[:, None]
    assert int(real.sum()) > 1000
    torch.testing.assert_close(fine.sigma[real], torch.full_like(fine.sigma[real], 3.0))
    torch.testing.assert_close(fine.alpha[real], 1 - torch.exp(-3.0 * fine.delta[real]))


def test_the_unbounded_last_sample_lies_behind_all_others(scene: Scene) -> None:
    """The last sample in open space is 10¹⁰ long. Its transmittance is the product over the samples before it."""
    method = guided(run(replace(scene, synthetic=False), 60, least=0.0))
    method.networks = {"fine": _Fog()}  # pyright: ignore[reportAttributeAccessIssue]
    rays = first_rays(scene)
    traced = method.trace(rays)
    fine = traced.passes[-1]
    assert fine.count is not None
    assert float(fine.delta.max()) > 1e9
    torch.testing.assert_close(fine.weights.sum(-1), traced.rendering.opacity, atol=1e-5, rtol=0)
    transmittance = torch.cat([torch.ones(len(rays), 1), (1 - fine.alpha).cumprod(-1)[:, :-1]], -1)
    torch.testing.assert_close(fine.transmittance, transmittance, atol=1e-5, rtol=0)
