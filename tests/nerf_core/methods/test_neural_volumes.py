"""Neural Volumes: additive opacity, the priors, the warps, and gradients that are computed piece by piece."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.methods.neural_volumes.config import NeuralVolumesConfig
from nerf_core.methods.neural_volumes.decoder import Volume
from nerf_core.methods.neural_volumes.explain import explain, magnification
from nerf_core.methods.neural_volumes.march import Box, add_up
from nerf_core.methods.neural_volumes.model import Net, NeuralVolumesModel, looked_up
from nerf_core.methods.neural_volumes.priors import FLOOR, ROUND, undecided, variation
from nerf_core.methods.neural_volumes.warp import POSE, AffineWarp, FieldWarp, lattice, rotations
from nerf_core.methods.stages import Pictures
from nerf_core.volume.compositing import composite

CPU = torch.device("cpu")
TINY = NeuralVolumesConfig(
    template=8, width=16, latent=4, warps=2, warp_cells=4, step=1.0, rays=16, chunk=64, learning_rate=1e-3
)


def model_of(scene: Scene, **changes: object) -> NeuralVolumesModel:
    return NeuralVolumesModel(scene, replace(TINY, **changes), CPU, 0)


def bias_of(net: Net) -> Tensor:
    """The biases of the template's channels: red, green, blue and opacity, before the activation."""
    bias = net.decoder.layers[-1].bias
    assert bias is not None
    return bias.data


def some_rays(scene: Scene, count: int = 16) -> tuple[Rays, Tensor]:
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    index = torch.linspace(0, len(rays) - 1, count).long()
    truth = torch.from_numpy(scene.images[0].reshape(-1, 3).astype("float32") / 65535)
    return rays[index], truth[index]


# ---- additive opacity ---------------------------------------------------------------------------------------------


def test_opacity_is_added_up_to_1_and_no_further() -> None:
    transmittance, weights = add_up(torch.tensor([[0.3, 0.5, 0.4, 0.2], [0.0, 0.1, 0.0, 0.2], [5.0, 1.0, 1.0, 1.0]]))
    torch.testing.assert_close(
        weights, torch.tensor([[0.3, 0.5, 0.2, 0.0], [0.0, 0.1, 0.0, 0.2], [1.0, 0.0, 0.0, 0.0]])
    )
    torch.testing.assert_close(
        transmittance, torch.tensor([[1.0, 0.7, 0.2, 0.0], [1.0, 1.0, 0.9, 0.9], [1.0, 0.0, 0.0, 0.0]])
    )


def test_fog_in_front_takes_nothing_from_a_surface_before_the_ray_is_full() -> None:
    """In NeRF the surface would keep 0.75 · 0.5; see `nerf_core.volume.compositing.absorb`."""
    assert float(add_up(torch.tensor([[0.25, 0.5]]))[1][0, 1]) == 0.5


def test_hidden_samples_have_no_gradient_and_seen_ones_the_difference_of_colours() -> None:
    opacity = torch.tensor([[0.3, 0.5, 0.4, 0.2]], requires_grad=True)
    shades = torch.tensor([[0.1, 0.7, 0.9, 0.5]])
    (add_up(opacity)[1] * shades).sum().backward()
    # more opacity of one sample is taken from the third, which fills what is left
    assert opacity.grad is not None
    torch.testing.assert_close(opacity.grad, torch.tensor([[0.1 - 0.9, 0.7 - 0.9, 0.0, 0.0]]))


def test_the_samples_of_a_trace_follow_the_additive_law(scene: Scene) -> None:
    model = model_of(scene)
    with torch.no_grad():
        model.shown.decoder.layers[-1].weight *= 8  # so that rays fill up
        bias_of(model.shown)[3] = 6.0
    samples = model.trace(some_rays(scene)[0]).passes[0]
    total = (samples.sigma * samples.delta).cumsum(-1).clamp(max=1)
    assert (total[:, -1] == 1).any()
    torch.testing.assert_close(
        samples.transmittance + samples.weights + total, 1 + 2 * samples.weights, atol=1e-5, rtol=0
    )
    torch.testing.assert_close(samples.alpha * samples.transmittance, samples.weights)
    assert (samples.alpha > 1 - torch.exp(-samples.sigma * samples.delta) + 0.01).any()  # the exponential law's


# ---- priors -------------------------------------------------------------------------------------------------------


def test_total_variation_is_the_mean_size_of_the_log_opacitys_gradient() -> None:
    opacity = torch.full((3, 3, 3), 2.0)
    opacity[1, 1, 1] = 6.0
    jump = math.log(6 + FLOOR) - math.log(2 + FLOOR)
    # of the 8 voxels with neighbours on all sides, one sees three jumps, and three see one
    by_hand = (math.sqrt(3 * jump**2 + ROUND) + 3 * math.sqrt(jump**2 + ROUND) + 4 * math.sqrt(ROUND)) / 8
    assert float(sum(variation(opacity, 1))) == pytest.approx(by_hand, rel=1e-6)
    assert float(sum(variation(opacity, 2))) == pytest.approx(by_hand, rel=1e-6)


def test_total_variation_smooths_thin_fog_as_much_as_thick() -> None:
    """Of the logarithm: what counts is the ratio of neighbours."""
    noise = torch.rand(4, 4, 4, generator=torch.Generator().manual_seed(0)) + 0.5
    assert float(sum(variation(0.1 * noise, 9))) == pytest.approx(float(sum(variation(10 * noise, 9))), rel=1e-3)


def test_the_opacity_prior_is_least_at_0_and_1() -> None:
    a = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    prior = undecided(a)
    by_hand = [0, math.log(0.35) + math.log(0.85) - math.log(0.11), 2 * math.log(0.6) - math.log(0.11), 0]
    np.testing.assert_allclose(prior.detach().numpy(), by_hand, atol=1e-12)
    prior.sum().backward()
    assert a.grad is not None
    assert a.grad[1] > 0  # descent makes a thin pixel empty
    assert a.grad[3] < 0  # and keeps an opaque one opaque


@pytest.mark.parametrize("name", ["tv_weight", "opacity_prior"])
def test_each_prior_alone_lowers_what_it_is_for(scene: Scene, name: str) -> None:
    rays, truth = some_rays(scene)
    measured = {}
    for weight in (0.0, 1.0):
        model = model_of(scene, **{"tv_weight": 0.0, "opacity_prior": 0.0, name: weight}, learning_rate=3e-3)
        for step in range(16):
            model.train(rays, truth, step, None, lambda: None)
        if name == "tv_weight":
            measured[weight] = float(sum(variation(model.volume.template[0, 3], 8)))
        else:
            measured[weight] = float(undecided(model.render(rays).opacity).mean())
    assert measured[1.0] < 0.8 * measured[0.0]


# ---- warps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("warp", ["affine", "field"])
def test_a_warp_begins_as_the_identity(warp: str) -> None:
    net = Net(replace(TINY, warp=warp))
    net.initialise(torch.Generator().manual_seed(3))
    with torch.no_grad():
        volume = net.volume()
    u = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    torch.testing.assert_close(volume.moved(u), u, atol=1e-5, rtol=0)
    assert magnification(volume, u[:1] / 2) == pytest.approx(1, abs=1e-4)


def test_one_affine_warp_moves_rotates_and_scales() -> None:
    """W⁻¹(x) = s ∘ R (x − t) with a turn of 90° about z."""
    warp = AffineWarp(4, 1, 4)
    warp.initialise(torch.Generator().manual_seed(0))
    half = math.sqrt(0.5)
    with torch.no_grad():
        warp.pose.bias.copy_(torch.tensor([math.log(2), 0, 0, half - 1, 0, 0, half, 0.25, 0, 0]) / POSE)
    found = warp.warp(torch.zeros(4))[0].permute(1, 2, 3, 0)
    x, y, z = lattice(4, torch.zeros(())).unbind(-1)
    torch.testing.assert_close(found, torch.stack([2 * -y, x - 0.25, z], -1))


def test_the_mixture_is_the_mean_by_the_weights_where_each_warp_leads() -> None:
    warp = AffineWarp(4, 2, 4)
    warp.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        warp.pose.bias.view(2, 10)[1, 7] = -0.5 / POSE  # the second warp moves points by 0.5
        warp.weight.weight.zero_()
        warp.weight.bias.view(2, -1)[1] = math.log(3)
    u = torch.tensor([[0.1, 0.2, 0.3]])
    torch.testing.assert_close(warp.shares(torch.zeros(4), u), torch.tensor([[0.25, 0.75]]))
    moved = Volume(torch.zeros(1, 4, 2, 2, 2), warp.warp(torch.zeros(4))).moved(u)
    torch.testing.assert_close(moved, u + torch.tensor([[0.375, 0, 0]]))


def test_rotations_are_orthogonal_and_turn_right_handed() -> None:
    found = rotations(torch.randn(5, 4, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(found @ found.mT, torch.eye(3).expand(5, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(5))


def test_a_scale_gives_a_region_more_voxels() -> None:
    """A template of 9 voxels, of which one is lit: with a scale of 2 it covers half the width."""
    template = torch.zeros(1, 4, 9, 9, 9)
    template[0, 3, :, :, 4] = 1.0
    double = 2 * lattice(4, torch.zeros(())).permute(3, 0, 1, 2)[None]
    x = torch.tensor([[0.0, 0, 0], [0.0625, 0, 0], [0.125, 0, 0], [0.6, 0, 0]])
    np.testing.assert_allclose(Volume(template, None).at(x)[0], [1, 0.75, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(Volume(template, double).at(x)[0], [1, 0.5, 0, 0], atol=1e-6)
    assert magnification(Volume(template, double), x[:1]) == pytest.approx(2, rel=1e-5)


# ---- gradients ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("warp", ["affine", "field", "none"])
def test_the_gradients_of_a_step_are_those_of_finite_differences(scene: Scene, warp: str) -> None:
    """In float64. The step computes them in pieces, and only where a sample can count; here all are computed."""
    model = model_of(scene, warp=warp, tv_weight=0.02, opacity_prior=0.05)
    generator = torch.Generator().manual_seed(5)
    for parameter in model.parameters():  # so that the warp moves points and rays fill up
        parameter.data += 0.03 * torch.randn(parameter.shape, generator=generator)
    bias_of(model.net)[3] = 6.0
    model.net.double()
    rays, truth = some_rays(scene)
    rays, truth = Rays(*(getattr(rays, n).double() for n in ("origins", "directions", "near", "far"))), truth.double()
    model.background = model.background.double()
    net = deepcopy(model.net)
    drawn = model.generator.get_state()
    model.train(rays, truth, 0, None, lambda: None)
    model.generator.set_state(drawn)
    offsets = torch.rand(len(rays), generator=model.generator)

    @torch.no_grad()
    def loss() -> float:
        volume, march = net.volume(), model.box.march(rays, model.step_length, offsets)
        alpha, rgb = volume.at(march.u)
        opacity = torch.zeros_like(march.length).masked_scatter(march.real, alpha) * march.length
        colors = torch.zeros(*march.real.shape, 3).double().masked_scatter(march.real[..., None], rgb)
        color, total = composite(add_up(opacity)[1], colors, model.background)
        prior = model.config.opacity_prior * undecided(total).mean()
        return float((color - truth).square().mean() + prior + 0.02 * sum(variation(volume.template[0, 3], 8)))

    checked = 0
    for (name, parameter), trained in zip(net.named_parameters(), model.parameters(), strict=True):
        assert trained.grad is not None
        for place in {0, parameter.numel() // 2, int(trained.grad.abs().argmax())}:
            flat, h = parameter.data.view(-1), 1e-6
            before = float(flat[place])
            flat[place] = before + h
            more = loss()
            flat[place] = before - h
            slope = (more - loss()) / (2 * h)
            flat[place] = before
            assert float(trained.grad.view(-1)[place]) == pytest.approx(slope, rel=1e-4, abs=1e-8), (name, place)
            checked += abs(slope) > 1e-5
    assert checked > 10


def test_samples_that_cannot_count_are_not_looked_up_and_change_nothing(scene: Scene) -> None:
    model = model_of(scene)
    bias_of(model.shown)[3] = 7.0
    rays = some_rays(scene)[0]
    march = model.box.march(rays, model.step_length, torch.full((len(rays),), 0.5))
    found, _ = looked_up(model.volume, march)
    alpha = model.volume.at(march.u)[0].detach()
    every = torch.zeros_like(march.length).masked_scatter(march.real, alpha) * march.length
    assert ((found == 0) & (every > 0)).any()
    torch.testing.assert_close(add_up(found)[1], add_up(every)[1], rtol=0, atol=0)
    samples = model.trace(rays).passes[0]  # shows what the hidden samples hold all the same
    torch.testing.assert_close(samples.sigma * samples.delta, every)
    assert torch.equal(model.trace(rays).rendering.color, model.render(rays).color)


# ---- samples in the box -------------------------------------------------------------------------------------------


def test_samples_cover_the_box_in_equal_steps_and_no_more() -> None:
    box = Box(Space("world", (0.0, 0.0, 0.0), 2.0, -np.ones(3), np.ones(3)), CPU)
    far = torch.tensor([[-4.0, 0.5, 0.0], [-4.0, 5.0, 0.0]])
    rays = Rays(far, torch.tensor([[1.0, 0, 0], [1.0, 0, 0]]), torch.ones(2), 9 * torch.ones(2))
    march = box.march(rays, 0.5, torch.tensor([0.5, 0.5]))
    assert march.real.tolist() == [[True] * 4, [False] * 4]
    torch.testing.assert_close(march.t[0], torch.tensor([2.5, 3.5, 4.5, 5.5]))  # a step is 0.5 of a half side of 2
    torch.testing.assert_close(march.delta[0], torch.tensor([1.0, 1.0, 1.0, 0.5]))
    torch.testing.assert_close(march.length[0], torch.tensor([0.5, 0.5, 0.5, 0.25]))
    torch.testing.assert_close(march.u[:, 0], torch.tensor([-0.75, -0.25, 0.25, 0.75]))


def test_samples_in_contracted_space_are_about_as_long_as_a_step_and_reach_far() -> None:
    box = Box(Space("contracted", (0.0, 0.0, 0.0), 1.0, -2 * np.ones(3), 2 * np.ones(3)), CPU)
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [1.0, 1, 0], [-1.0, 0.2, 0.1]]), dim=-1)
    rays = Rays(torch.tensor([[-0.5, 0, 0], [0.0, 0, 0], [3.0, 0, 0]]), directions, torch.zeros(3), torch.ones(3))
    march = box.march(rays, 0.05, torch.zeros(3))
    length = march.length[march.real]
    assert float(length.max()) < 2 * 0.05
    assert float(length.median()) == pytest.approx(0.05, rel=0.3)
    assert (march.t.amax(-1) > 100).all()
    assert (march.t.diff(dim=-1) >= 0).all()


# ---- the model ----------------------------------------------------------------------------------------------------


def test_a_decoded_volume_is_kept_until_the_weights_change(scene: Scene) -> None:
    model = model_of(scene)
    first = model.volume
    assert model.volume is first
    frozen = model.frozen()
    rays, truth = some_rays(scene)
    before = frozen.render(rays).color
    for step in range(4):  # the EMA of the weights, which pictures show, moves at every fourth step
        model.train(rays, truth, step, None, lambda: None)
    assert not torch.equal(model.volume.template, first.template)
    assert torch.equal(frozen.render(rays).color, before)
    saved = {name: value.clone() for name, value in model.state().items()}
    trained = model.render(rays).color
    for step in range(4, 8):
        model.train(rays, truth, step, None, lambda: None)
    assert not torch.equal(model.render(rays).color, trained)
    model.load_state(saved)
    assert torch.equal(model.render(rays).color, trained)


@pytest.mark.parametrize(
    "changes", [{"warp": "none"}, {"warp": "field"}, {"tv_weight": 0.0}, {"opacity_prior": 0.0}, {"step": 2.0}]
)
def test_each_part_can_be_switched_off(scene: Scene, changes: dict[str, object]) -> None:
    model = model_of(scene, **changes)
    rays, truth = some_rays(scene)
    losses = [model.train(rays, truth, step, None, lambda: None) for step in range(12)]
    assert losses[-1] < losses[0]
    assert (model.net.warp is None) == (changes.get("warp") == "none")
    assert isinstance(model.net.warp, FieldWarp) == (changes.get("warp") == "field")


def test_the_walk_shows_where_the_point_is_moved_and_how_opacity_adds_up(scene: Scene) -> None:
    rays, truth = some_rays(scene)
    for warp in ("affine", "field", "none"):
        model = model_of(scene, warp=warp)
        model.train(rays, truth, 0, None, lambda: None)
        stages = {stage.title: stage for stage in explain(model, rays[8:9])}
        assert ("Inverse warp" in stages) == (warp != "none")
        slices = stages["Template"].charts[0]
        assert isinstance(slices, Pictures)
        assert [image.shape for image in slices.images] == [(8, 8, 4)] * 3
        assert slices.marks.shape == (3, 2)
        assert "exp" not in stages["Additive opacity"].sentence


def test_the_slices_show_the_marked_voxel(scene: Scene) -> None:
    """Each slice's pixel under its mark has the template's colour at the heaviest sample's nearest voxel."""
    model = model_of(scene, warp="none")
    template = torch.rand(1, 4, 8, 8, 8, generator=torch.Generator().manual_seed(2))
    template[:, 3] *= 3
    model._volume = Volume(template, None)
    rays = some_rays(scene)[0][8:9]
    samples = model.trace(rays).passes[0]
    slices = next(s for s in explain(model, rays) if s.title == "Template").charts[0]
    assert isinstance(slices, Pictures)
    best = int(samples.weights[0].argmax())
    u = model.cube(rays.origins + samples.t[:, best, None] * rays.directions)[0]
    x, y, z = ((u + 1) / 2 * 7).round().int().tolist()
    wanted = (template[0, :3, z, y, x] * 255 + 0.5).byte().numpy()
    for image, (column, row) in zip(slices.images, slices.marks, strict=True):
        np.testing.assert_array_equal(image[int(row), int(column), :3], wanted)


@pytest.mark.parametrize("name", ["template", "warp_cells"])
def test_sides_must_be_powers_of_two(scene: Scene, name: str) -> None:
    with pytest.raises(UserError, match=f"--set {name}=12: must be a power of two"):
        NeuralVolumesConfig.configure(scene, "auto", {name: "12"}, CPU)
