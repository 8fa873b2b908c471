"""Scene representation networks against the paper's equations, by hand and by finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Dense, Radiant, Traceable, Visiting
from nerf_core.methods.srn.config import SrnConfig
from nerf_core.methods.srn.method import Srn
from nerf_core.methods.srn.model import behind_camera
from nerf_core.methods.srn.network import NormedLayer, SrnNetwork
from nerf_core.methods.stages import BarCode, Marks, Stems
from nerf_core.probe import open_ray
from nerf_core.probe.walkthrough import walk
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
TINY = SrnConfig(march_steps=3, layers=2, generator_layers=2, width=6, hidden=3, rays=16, chunk_rays=8, tile=16)


def batch(scene: Scene, count: int = 16) -> tuple[Rays, Tensor]:
    rays = camera_rays(scene.views[1].camera, scene.near, scene.far)
    index = torch.randperm(len(rays), generator=torch.Generator().manual_seed(3))[:count]
    return rays[index], torch.from_numpy(scene.images[1].reshape(-1, 3)[index.numpy()].astype("float32") / 65535)


def normed(x: Tensor) -> Tensor:
    """Layer norm by its definition: mean 0 and variance 1 over the units, with torch's epsilon of 1e-5."""
    return (x - x.mean(-1, keepdim=True)) / (x.var(-1, unbiased=False, keepdim=True) + 1e-5).sqrt()


def test_the_default_network_has_the_papers_size() -> None:
    c = SrnConfig()
    network = SrnNetwork(c.layers, c.generator_layers, c.width, c.hidden)
    sizes = [sum(p.numel() for p in part.parameters()) for part in (network.scene, network.marcher, network.generator)]
    assert sizes == [
        (3 + 1) * 256 + 3 * (256 + 1) * 256 + 4 * 2 * 256,
        4 * 16 * (256 + 1 + 16 + 1) + 16 + 1,
        5 * (256 + 1) * 256 + 5 * 2 * 256,
    ]
    assert sum(p.numel() for p in network.parameters()) == 550_292


def test_a_layer_is_normed_before_its_relu() -> None:
    layer = NormedLayer(2, 3)
    with torch.no_grad():
        layer.linear.weight.copy_(torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
        layer.linear.bias.copy_(torch.tensor([0.0, 1.0, 2.0]))
        layer.norm.weight.copy_(torch.tensor([1.0, 2.0, 1.0]))
        layer.norm.bias.copy_(torch.tensor([0.5, 0.0, 0.0]))
        got = layer(torch.tensor([[2.0, 1.0]]))
    # W x + b = (2, 2, 5): mean 3, variance 2, so that the norm is (−1, −1, 2) / √2
    assert got[0].tolist() == pytest.approx([0, 0, 2**0.5], abs=1e-5)
    with torch.no_grad():
        layer.norm.bias.copy_(torch.tensor([1.0, 2.0, 0.0]))
        assert layer(torch.tensor([[2.0, 1.0]]))[0].tolist() == pytest.approx(
            [1 - 0.5**0.5, 2 - 2**0.5, 2**0.5], abs=1e-5
        )


def transcribed(w: dict[str, Tensor], o: Tensor, d: Tensor, start: float, steps: int) -> tuple[Tensor, Tensor]:
    """The distances (R, N + 1) and colours (R, 3) of Algorithm 1, ray by ray, from weights by name."""

    def layers(name: str, x: Tensor, count: int = 2) -> Tensor:
        for i in range(count):
            x = normed(w[f"{name}.{i}.linear.weight"] @ x + w[f"{name}.{i}.linear.bias"])
            x = torch.relu(x * w[f"{name}.{i}.norm.weight"] + w[f"{name}.{i}.norm.bias"])
        return x

    distances, colors = [], []
    for origin, direction in zip(o, d, strict=True):
        t, h, c, places = origin.new_tensor(start), origin.new_zeros(3), origin.new_zeros(3), []
        for _ in range(steps):
            places.append(t)
            v = layers("scene", origin + t * direction)
            gates = w["marcher.features.weight"] @ v + w["marcher.features.bias"]
            gates = gates + w["marcher.memory.weight"] @ h + w["marcher.memory.bias"]
            i, f, g, out = gates[0:3], gates[3:6], gates[6:9], gates[9:12]
            c = c / (1 + torch.exp(-f)) + torch.tanh(g) / (1 + torch.exp(-i))
            h = torch.tanh(c) / (1 + torch.exp(-out))
            t = t + w["marcher.step.weight"][0] @ h + w["marcher.step.bias"][0]
        distances.append(torch.stack([*places, t]))
        v = layers("generator", layers("scene", origin + t * direction))
        colors.append(0.5 + 0.5 * (w["rgb.weight"] @ v + w["rgb.bias"]))
    return torch.stack(distances), torch.stack(colors)


def test_it_marches_and_paints_by_the_papers_equations(scene: Scene) -> None:
    """In the network's coordinates a world point is (x − centre) / unit. An object's unit is (far − near) / 2 = 2."""
    moved = replace(scene, center=np.array([0.3, -0.2, 0.1]))
    method = Srn(moved, replace(TINY, start=0.8), CPU, 0)
    rays, _ = batch(scene)
    origins = (rays.origins - torch.tensor([0.3, -0.2, 0.1])) / 2
    with torch.no_grad():
        t, color = transcribed(dict(method.network.named_parameters()), origins, rays.directions, 0.8 * 2 / 2, 3)
    torch.testing.assert_close(method.visited(rays), 2 * t, rtol=1e-4, atol=1e-5)
    drawn = method.render(rays)
    torch.testing.assert_close(drawn.color, color.clamp(0, 1), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(drawn.depth, 2 * t[:, -1], rtol=1e-4, atol=1e-5)
    assert (drawn.opacity == 1).all()
    assert t.diff(dim=-1).abs().min() > 1e-6  # every step moves


def test_the_visited_places_are_where_the_scene_network_is_asked(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    method, (rays, _) = Srn(scene, TINY, CPU, 0), batch(scene)
    asked: list[Tensor] = []
    features = SrnNetwork.features

    def noting(network: SrnNetwork, x: Tensor) -> Tensor:
        asked.append(x)
        return features(network, x)

    monkeypatch.setattr(SrnNetwork, "features", noting)
    t = method.visited(rays)
    assert t.shape == (16, 4)
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    torch.testing.assert_close(torch.stack(asked, 1) * 2, points)  # the centre is 0, the unit 2


def test_the_regulariser_punishes_only_what_is_behind_the_camera(scene: Scene) -> None:
    assert behind_camera(torch.tensor([-2.0, -0.5, 0.0, 3.0])).tolist() == [4, 0.25, 0, 0]
    method, (rays, truth) = Srn(scene, replace(TINY, depth_weight=3.0), CPU, 0), batch(scene)
    with torch.no_grad():
        method.network.marcher.step.bias.fill_(-1.0)  # all rays end behind the camera
        loss, squared = method.loss(rays, truth)
        t, color = method.march(rays).t[:, -1], method.network.color(method.march(rays).features)
    assert (t < 0).all()
    assert float(loss) == pytest.approx(float((color - truth).square().mean() + 3 * t.square().mean()), rel=1e-5)
    assert float(squared.mean()) == pytest.approx(float((color.clamp(0, 1) - truth).square().mean()), rel=1e-5)
    assert (method.render(rays).depth == 0).all()


def test_the_gradient_is_that_of_finite_differences(scene: Scene) -> None:
    """In float64, through the marcher: all that a parameter changes, where the points lie included."""
    method, (rays, truth) = Srn(scene, replace(TINY, depth_weight=2.0), CPU, 1), batch(scene, 4)
    method.network.double()
    method.center = method.center.double()
    exact = Rays(*(v.double() for v in (rays.origins, rays.directions, rays.near, rays.far)))
    with torch.no_grad():
        method.network.marcher.step.bias.fill_(-0.4)  # some of the rays end behind the camera
        behind = method.march(exact).t[:, -1] < 0
        assert behind.any()
    method.optimizer.zero_grad(set_to_none=False)
    for parameter in method.parameters():
        parameter.grad = torch.zeros_like(parameter)
    method.loss(exact, truth.double())[0].backward()
    picked = torch.Generator().manual_seed(0)
    for name, parameter in method.network.named_parameters():
        assert parameter.grad is not None
        for _ in range(2):
            place = int(torch.randint(parameter.numel(), (), generator=picked))
            flat, losses = parameter.data.view(-1), []
            middle = float(flat[place])
            for step in (-1e-6, 1e-6):
                flat[place] = middle + step
                losses.append(float(method.loss(exact, truth.double())[0].detach()))
            flat[place] = middle
            expected = (losses[1] - losses[0]) / 2e-6
            assert float(parameter.grad.view(-1)[place]) == pytest.approx(expected, rel=1e-4, abs=1e-8), name


def test_chunks_do_not_change_the_gradient(scene: Scene) -> None:
    rays, truth = batch(scene)
    grads = []
    for chunk in (16, 5):
        method = Srn(scene, replace(TINY, chunk_rays=chunk), CPU, 0)
        calls: list[int] = []
        method.train(rays, truth, 0, None, lambda calls=calls: calls.append(1))
        assert len(calls) == -(-16 // chunk)
        grads.append([p.grad.clone() for p in method.parameters() if p.grad is not None])
    for one, other in zip(*grads, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def test_the_learning_rate_decays_over_the_run(scene: Scene) -> None:
    method, (rays, truth) = (
        Srn(scene, replace(TINY, learning_rate=0.01, decay=0.25, total_steps=8), CPU, 0),
        batch(scene),
    )
    for step, steps, rate in ((0, None, 0.01), (4, None, 0.005), (8, None, 0.0025), (4, 4, 0.0025)):
        method.train(rays, truth, step, steps, lambda: None)
        assert method.optimizer.param_groups[0]["lr"] == pytest.approx(rate)


def test_bfloat16_keeps_distances_in_single_precision(scene: Scene) -> None:
    config = replace(TINY, width=64, hidden=16, march_steps=10)
    rays, _ = batch(scene)
    exact = Srn(scene, config, CPU, 0).visited(rays)
    rounded = Srn(scene, replace(config, precision="bfloat16"), CPU, 0).visited(rays)
    assert rounded.dtype == torch.float32
    assert (
        0 < float((rounded / exact - 1).abs().max()) < 0.01
    )  # bfloat16 itself rounds by up to 0.4 %, and Φ has layers


@pytest.mark.parametrize("seed", [0, 1])
def test_the_first_march_ends_near_the_middle_of_the_scene(scene: Scene, seed: int) -> None:
    """The cameras are 4 away from it, and the steps are even but for a part that the features decide."""
    method = Srn(scene, SrnConfig(), CPU, seed)
    t = method.visited(batch(scene)[0])
    assert t[:, 0].tolist() == [2.0] * 16
    assert ((t[:, -1] - 4).abs() < 1).all()
    assert (t.diff(dim=-1) > 0).all()


def test_it_learns_the_ball_and_its_depth(scene: Scene) -> None:
    changes = {
        "width": "64", "layers": "3", "generator_layers": "2", "rays": "256", "chunk_rays": "256", "march_steps": "6",
        "learning_rate": "0.003",
    }  # fmt: skip
    trainer = Trainer(scene, RunSettings(method="srn", changes=changes, device="cpu", threads=1, steps=100))
    rays = camera_rays(scene.views[5].camera, scene.near, scene.far)  # held out
    ahead = -(rays.origins * rays.directions).sum(-1)
    root = ahead.square() - rays.origins.square().sum(-1) + 1
    hit = root > 0.1  # away from the ball's outline
    depth = (ahead - root.clamp(min=0).sqrt())[hit]

    def error() -> float:
        return float((trainer.method.render(rays).depth[hit] - depth).abs().mean())

    before = error()
    losses = [trainer.step().loss for _ in range(100)]
    assert np.mean(losses[-10:]) < 0.3 * np.mean(losses[:5])
    assert error() < 0.5 * before


def test_it_has_no_samples_and_says_what_it_does_instead(scene: Scene) -> None:
    method = Srn(scene, TINY, CPU, 0)
    assert isinstance(method, Visiting)
    assert not isinstance(method, (Traceable, Radiant, Dense))  # no σ, no w, and no direction in its colours
    camera = scene.views[0].camera
    with torch.no_grad():
        method.network.marcher.step.bias.fill_(-0.3)  # so that the opened ray begins before the start
    ray = open_ray(method, scene, camera, (8, 8), 1)
    assert ray.passes == ()
    assert len(ray.visited) == 4
    assert ray.near < 2
    stages = {stage.title: stage for stage in walk(method, scene, camera, ray)}
    assert list(stages)[2:6] == ["Start", "March", "Found point", "Pixel generator"]
    assert all(word in stages["Start"].sentence for word in ("no density σ", "no transmittance T", "no weights w"))
    marks, stems = stages["March"].charts
    assert isinstance(marks, Marks)
    assert isinstance(stems, Stems)
    np.testing.assert_allclose(marks.t, ray.visited, rtol=1e-5)  # explained as it was opened
    np.testing.assert_allclose(marks.t[:-1] + stems.y, marks.t[1:], rtol=1e-5)
    code = stages["Found point"].charts[0]
    assert isinstance(code, BarCode)
    assert len(code.values[0]) == 6


def test_a_scene_without_training_photos_is_refused(scene: Scene) -> None:
    with pytest.raises(UserError, match="no training photos"):
        Trainer(replace(scene, splits={"test": (0, 1)}), RunSettings(method="srn", device="cpu", threads=1))


def test_another_preset_is_refused(scene: Scene) -> None:
    with pytest.raises(UserError, match="method srn has none but auto"):
        SrnConfig.configure(scene, "quick", {}, CPU)
