"""The paper's method against a plain transcription of the paper, in single precision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.ndc import FARTHEST, Ndc
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.methods.nerf.method import Nerf
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
CONFIG = NerfConfig(rays=24, coarse_samples=10, fine_samples=14, depth=7, width=20, chunk_rays=24)


# ---- the paper ----------------------------------------------------------------------------------------------------


def gamma(p: Tensor, frequencies: int) -> Tensor:
    parts = [p]
    for k in range(frequencies):
        parts += [torch.sin(2**k * p), torch.cos(2**k * p)]
    return torch.cat(parts, -1)


def network(w: dict[str, Tensor], c: NerfConfig, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    def linear(name: str, h: Tensor) -> Tensor:
        return nn.functional.linear(h, w[f"{name}.weight"], w[f"{name}.bias"])

    encoded = gamma(x, c.position_frequencies)
    h = encoded
    for i in range(c.depth):
        if i == 5:
            h = torch.cat([encoded, h], -1)
        h = torch.relu(linear(f"trunk.{i}", h))
    sigma = linear("density", h)[..., 0]
    branch = torch.cat([linear("feature", h), gamma(d, c.direction_frequencies)], -1)
    return sigma, torch.sigmoid(linear("rgb", torch.relu(linear("branch", branch))))


def render(w: dict[str, Tensor], c: NerfConfig, rays: Rays, t: Tensor, draws: torch.Generator) -> tuple[Tensor, Tensor]:
    """Colour on white and weights, by the products of Eq. 3."""
    x = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    raw, rgb = network(w, c, x, rays.directions[:, None].expand_as(x))
    if c.density_noise:
        raw = raw + c.density_noise * torch.randn(raw.shape, generator=draws)
    delta = torch.cat([t[:, 1:] - t[:, :-1], torch.full_like(t[:, :1], 1e10)], -1)
    alpha = 1 - torch.exp(-torch.relu(raw) * delta)
    transmittance = torch.cat([torch.ones_like(alpha[:, :1]), torch.cumprod(1 - alpha, -1)[:, :-1]], -1)
    weights = transmittance * alpha
    return (weights[..., None] * rgb).sum(1) + 1 - weights.sum(-1, keepdim=True), weights


def _inverse(bounds: list[float], cdf: list[float], u: float) -> float:
    """Inverse transform: where the distribution that is constant between the bounds reaches the share u."""
    k = 0
    while k < len(cdf) - 2 and cdf[k + 1] <= u:
        k += 1
    return bounds[k] + (u - cdf[k]) / (cdf[k + 1] - cdf[k]) * (bounds[k + 1] - bounds[k])


def paper_loss(
    nets: dict[str, dict[str, Tensor]], c: NerfConfig, rays: Rays, truth: Tensor, draws: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Sums of squared errors of the coarse and the fine picture."""
    count = c.coarse_samples
    t = rays.near[:, None] + (rays.far - rays.near)[:, None] * torch.linspace(0, 1, count)
    middle = (t[:, 1:] + t[:, :-1]) / 2
    lower, upper = torch.cat([t[:, :1], middle], -1), torch.cat([middle, t[:, -1:]], -1)
    t = lower + (upper - lower) * torch.rand(t.shape, generator=draws)
    coarse, weights = render(nets["coarse"], c, rays, t, draws)
    middle = (t[:, 1:] + t[:, :-1]) / 2
    mass = weights[:, 1:-1].detach() + 1e-5
    cdf = torch.cat([torch.zeros(len(t), 1), (mass / mass.sum(-1, keepdim=True)).cumsum(-1)], -1)
    u = torch.rand(len(t), c.fine_samples, generator=draws)
    fine_t = torch.tensor(
        [
            [_inverse(bounds, edges, x) for x in draw]
            for bounds, edges, draw in zip(middle.tolist(), cdf.tolist(), u.tolist(), strict=True)
        ]
    )
    fine, _ = render(nets["fine"], c, rays, torch.cat([t, fine_t], -1).sort(-1).values, draws)
    return (coarse - truth).square().sum(), (fine - truth).square().sum()


def copied(method: Nerf) -> dict[str, dict[str, Tensor]]:
    return {
        name: {k: v.detach().clone().requires_grad_() for k, v in net.named_parameters()}
        for name, net in method.networks.items()
    }


def batch(scene: Scene, count: int, seed: int = 3) -> tuple[Rays, Tensor]:
    rays = camera_rays(scene.views[1].camera, scene.near, scene.far)
    index = torch.randperm(len(rays), generator=torch.Generator().manual_seed(seed))[:count]
    return rays[index], torch.from_numpy(scene.images[1].reshape(-1, 3)[index.numpy()].astype("float32") / 65535)


def gradients(method: Nerf) -> dict[str, Tensor]:
    return {
        f"{name}.{k}": p.grad.clone()
        for name, net in method.networks.items()
        for k, p in net.named_parameters()
        if p.grad is not None
    }


def assert_same_gradients(got: dict[str, Tensor], truth: dict[str, Tensor], tolerance: float) -> None:
    assert got.keys() == truth.keys()
    for name, value in truth.items():
        assert float((got[name] - value).norm()) <= tolerance * float(value.norm()) + 1e-9, name


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("chunk", [24, 7])
@pytest.mark.parametrize("sparse", [False, True])
def test_a_step_has_the_loss_and_the_gradients_of_the_paper(
    scene: Scene, noise: float, chunk: int, sparse: bool
) -> None:
    # sin(2⁹ p) would show each processor's rounding of p, 500 times as large, in place of an error of the formula
    config = replace(CONFIG, density_noise=noise, chunk_rays=chunk, position_frequencies=6)
    method = Nerf(scene, config, CPU, seed=5)
    share = torch.tensor(0.0 if sparse else 1.0)
    method.load_state(method.state() | {"alive.coarse": share, "alive.fine": share})
    nets, draws = copied(method), torch.Generator().manual_seed(5)
    rays, truth = batch(scene, 24)
    loss = method.train(rays, truth, 0, None, lambda: None)
    parts = [paper_loss(nets, config, rays[i : i + chunk], truth[i : i + chunk], draws) for i in range(0, 24, chunk)]
    coarse, fine = (sum(p[i] for p in parts) / truth.numel() for i in (0, 1))
    assert isinstance(coarse, Tensor)
    assert isinstance(fine, Tensor)
    (coarse + fine).backward()
    assert loss == pytest.approx(float(fine.detach()), rel=1e-4)
    expected = {f"{name}.{k}": v.grad for name, w in nets.items() for k, v in w.items() if v.grad is not None}
    assert_same_gradients(gradients(method), expected, 1e-4)


@pytest.mark.parametrize("steps", [None, 40])
def test_adam_follows_the_schedule_of_steps(scene: Scene, steps: int | None) -> None:
    config = replace(CONFIG, decay_steps=10, learning_rate=1e-2)
    method = Nerf(scene, config, CPU, seed=0)
    reference = [p.detach().clone().requires_grad_() for p in method.parameters()]
    adam = torch.optim.Adam(reference, lr=1, eps=1e-7)
    for step in range(5):
        method.train(*batch(scene, 24, seed=step), step, steps, lambda: None)
        for ours, theirs in zip(method.parameters(), reference, strict=True):
            theirs.grad = ours.grad
        adam.param_groups[0]["lr"] = 1e-2 * 0.1 ** (step / (steps or 10))
        adam.step()
    for ours, theirs in zip(method.parameters(), reference, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-4)


def test_backpropagating_only_living_samples_gives_the_same_gradients(scene: Scene) -> None:
    found = []
    for share in (0.0, 1.0):
        method = Nerf(scene, CONFIG, CPU, seed=2)
        for net in method.networks.values():  # most of space empty, as late in a training
            nn.init.constant_(net.density.bias, -0.05)
        alive = torch.tensor(share)
        method.load_state(method.state() | {"alive.coarse": alive, "alive.fine": alive})
        method.train(*batch(scene, 24), 0, None, lambda: None)
        found.append((gradients(method), method.state()["alive.fine"]))
    assert 0 < float(found[0][1]) < 0.6
    assert found[0][1] == found[1][1]
    assert_same_gradients(found[0][0], found[1][0], 1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"adam.3.exp_avg": torch.zeros(3)},
        {"adam.3.exp_avg_sq": torch.zeros(20, 20, dtype=torch.float64)},
        {"adam.3.step": torch.zeros(2)},
        {"adam.3.exp_avg": None},
    ],
)
def test_an_optimisers_state_that_does_not_fit_is_refused(scene: Scene, change: dict[str, Tensor | None]) -> None:
    """The fused kernel would write past the end of a tensor that is too small."""
    method = Nerf(scene, CONFIG, CPU, 0)
    method.train(*batch(scene, 24), 0, None, lambda: None)
    state = {k: v for k, v in (method.state() | change).items() if v is not None}
    with pytest.raises(ValueError, match="the optimiser's state of parameter 3 does not fit"):
        method.load_state(state)


def test_a_dead_network_is_resumed_bit_for_bit(scene: Scene) -> None:
    """Adam's momentum moves the weights although no sample has a gradient. A resumed Adam must do the same."""
    first = Nerf(scene, replace(CONFIG, fine_samples=0), CPU, seed=0)
    first.train(*batch(scene, 24), 0, None, lambda: None)
    nn.init.constant_(first.networks["coarse"].density.bias, -100.0)
    second = Nerf(scene, first.config, CPU, seed=0)
    second.load_state(first.state())
    for method in (first, second):
        method.train(*batch(scene, 24), 1, None, lambda: None)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_it_learns(make_trainer: Callable[..., Trainer]) -> None:
    trainer = make_trainer(
        learning_rate=5e-3, position_frequencies=2, rays=128, chunk_rays=128, width=48, one_image=False
    )
    losses = [trainer.step().loss for _ in range(60)]
    assert sum(losses[-3:]) < sum(losses[:3]) / 4


def test_the_generator_of_a_checkpoint_from_another_kind_of_device_starts_anew(scene: Scene) -> None:
    """A CUDA generator's state is 16 bytes long. A checkpoint with it still loads on a CPU."""
    method = Nerf(scene, CONFIG, CPU, seed=4)
    fresh = method.state()["generator"].clone()
    method.load_state(method.state() | {"generator": torch.zeros(16, dtype=torch.uint8)})
    assert torch.equal(method.state()["generator"], fresh)


# ---- the pieces ---------------------------------------------------------------------------------------------------


def test_without_hierarchy_there_is_one_network_and_one_pass(scene: Scene) -> None:
    method = Nerf(scene, replace(CONFIG, fine_samples=0), CPU, 0)
    assert list(method.networks) == ["coarse"]
    rays, _ = batch(scene, 3)
    assert [(p.name, p.t.shape) for p in method.trace(rays).passes] == [("coarse", (3, 10))]
    assert torch.equal(method.render(rays, "coarse").color, method.render(rays, "fine").color)


def test_the_fine_pass_is_the_sorted_union(scene: Scene) -> None:
    method = Nerf(scene, CONFIG, CPU, 0)
    coarse, fine = method.trace(batch(scene, 5)[0]).passes
    assert (coarse.name, fine.name) == ("coarse", "fine")
    assert fine.t.shape == (5, 24)
    for ray in range(5):
        assert set(coarse.t[ray].tolist()) <= set(fine.t[ray].tolist())
    torch.testing.assert_close(fine.delta[:, :-1], fine.t.diff(dim=-1))
    assert (fine.delta[:, -1] == 1e10).all()


def test_more_rays_than_a_tile_cannot_be_opened(scene: Scene) -> None:
    method = Nerf(scene, replace(CONFIG, tile=4), CPU, 0)
    with pytest.raises(ValueError, match="at most 4 rays at a time, got 5"):
        method.trace(batch(scene, 5)[0])


@pytest.mark.parametrize("view_directions", [True, False])
def test_radiance_is_what_the_network_emits(scene: Scene, view_directions: bool) -> None:
    method = Nerf(scene, replace(CONFIG, view_directions=view_directions), CPU, 0)
    directions = nn.functional.normalize(torch.randn(9, 3), dim=-1)
    point, net = torch.tensor([0.3, -0.2, 0.5]), method.networks["fine"]
    _, rgb = net(point.expand(9, 3), net.encode_directions(directions))
    torch.testing.assert_close(method.radiance(point[None], directions)[0], rgb)


# ---- NDC ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def forward(scene: Scene) -> Scene:
    """A capture of cameras that look along −z, in normalised device coordinates."""
    c2w = torch.eye(4, dtype=torch.float64)[:3].numpy()
    views = tuple(replace(view, camera=view.camera.moved(c2w)) for view in scene.views)
    ndc = Ndc(16, 16, scene.views[0].camera.fx, 1.0, 20.0)
    return replace(scene, views=views, ndc=ndc, near=1.0, far=20.0, background=(0.2, 0.4, 0.6))


def test_under_ndc_t_is_world_distance_and_delta_is_not(forward: Scene) -> None:
    method = Nerf(forward, CONFIG, CPU, 0)
    rays = camera_rays(forward.views[0].camera, 1.0, 20.0)[:6]
    coarse = method.trace(rays).passes[0]
    z = -coarse.t * rays.directions[:, 2:]
    torch.testing.assert_close(z[:, 0], torch.ones(6))
    torch.testing.assert_close(z[:, -1], torch.full((6,), FARTHEST), rtol=1e-4, atol=0)  # t′ = 1 is infinity
    torch.testing.assert_close(z[:, 3], torch.full((6,), 1 / (1 - 3 / 9)))
    assert forward.ndc is not None
    _, d_ndc, _ = forward.ndc.rays(rays.origins, rays.directions)
    torch.testing.assert_close(coarse.delta[:, :-1], (d_ndc.norm(dim=-1) / 9)[:, None].expand(6, 9))


def test_a_camera_that_turns_away_sees_background(forward: Scene) -> None:
    method = Nerf(forward, CONFIG, CPU, 0)
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))[:3].numpy()
    rays = camera_rays(forward.views[0].camera.moved(back), 1.0, 20.0)
    drawn = method.render(rays)
    torch.testing.assert_close(drawn.color, torch.tensor(forward.background).expand(256, 3))
    assert not drawn.opacity.any()
    assert drawn.depth.isnan().all()
    for name, value in vars(method.trace(rays[:4]).passes[-1]).items():
        assert name in ("name", "count") or value.isfinite().all(), name
    loss = method.train(rays[:24], torch.ones(24, 3), 0, None, lambda: None)
    assert loss == pytest.approx(float((1 - torch.tensor(forward.background)).square().mean()), rel=1e-5)
    assert all(not g.any() for g in gradients(method).values())


@pytest.mark.parametrize("z", [0.5, -2.0, -7.0, -19.0])
def test_a_camera_within_the_scene_sees_nothing_behind_itself(forward: Scene, z: float) -> None:
    method = Nerf(forward, CONFIG, CPU, 0)
    c2w = forward.views[0].camera.c2w.copy()
    c2w[2, 3] = z
    rays = camera_rays(forward.views[0].camera.moved(c2w), 1.0, 20.0)[100:104]
    for one in method.trace(rays).passes:
        assert (one.t >= -1e-4).all()
        assert (one.t[:, 1:] >= one.t[:, :-1]).all()
        depth = z + one.t * rays.directions[:, 2:]
        torch.testing.assert_close(depth[:, 0], torch.full((4,), min(z, -1.0)), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(depth[:, -1], torch.full((4,), -FARTHEST), rtol=1e-3, atol=0)


def test_radiance_under_ndc_is_evaluated_at_the_projected_point(forward: Scene) -> None:
    method = Nerf(forward, CONFIG, CPU, 0)
    directions = nn.functional.normalize(torch.randn(9, 3), dim=-1)
    world, net = torch.tensor([0.3, -0.2, -2.5]), method.networks["fine"]
    scale = 2 * forward.views[0].camera.fx / 16
    x = torch.tensor([scale * 0.3 / 2.5, scale * -0.2 / 2.5, 1 - 2 / 2.5])
    _, rgb = net(x.expand(9, 3), net.encode_directions(directions))
    torch.testing.assert_close(method.radiance(world[None], directions)[0], rgb)


def test_samples_are_linear_in_disparity_where_the_scene_says_so(scene: Scene) -> None:
    coarse = Nerf(replace(scene, disparity=True), CONFIG, CPU, 0).trace(batch(scene, 4)[0]).passes[0]
    steps = (1 / coarse.t).diff(dim=-1)
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps), rtol=1e-3, atol=1e-6)


def test_state_is_tensors_alone(scene: Scene) -> None:
    method = Nerf(scene, CONFIG, CPU, 0)
    method.train(*batch(scene, 24), 0, None, lambda: None)
    state: dict[str, Any] = method.state()
    assert all(isinstance(value, Tensor) for value in state.values())
    assert {name.split(".")[0] for name in state} == {"coarse", "fine", "adam", "generator", "alive"}
