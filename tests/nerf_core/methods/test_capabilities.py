"""A method that only trains and renders: what it lacks is reported, and nothing breaks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Defaults, Draw, lacking
from nerf_core.probe import open_pixel, open_ray
from nerf_core.probe.walkthrough import walk
from nerf_core.rendering.images import render_camera
from nerf_core.rendering.modes import MODES, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


@dataclass(frozen=True)
class PlainConfig:
    total_steps: int = 10
    train_images: int = 0

    def to_json(self) -> dict[str, Any]:
        return {}


class Plain(Defaults):
    """One colour for all pixels: the mean of the photos."""

    summary: ClassVar[str] = "One colour."
    constants: ClassVar[type[PlainConfig]] = PlainConfig
    tile = 64

    def __init__(self, scene: Scene, config: PlainConfig, device: torch.device, seed: int) -> None:
        self.config, self.device, self.color = config, torch.device("cpu"), torch.zeros(3)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> PlainConfig:
        return PlainConfig()

    @staticmethod
    def restore(config: Mapping[str, Any]) -> PlainConfig:
        return PlainConfig()

    def draw(self, step: int) -> Draw:
        return Draw(16)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        error = float((truth - self.color).square().mean())
        yield_callback()
        self.color = self.color + (truth.mean(0) - self.color) / (step + 1)
        return error

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        one = torch.ones(len(rays))
        return Rendering(self.color.expand(len(rays), 3).clone(), one, one * torch.nan)

    def state(self) -> dict[str, Tensor]:
        return {"color": self.color}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.color = state["color"].clone()

    def parameters(self) -> list[Tensor]:
        return [self.color]


class Sampled(Plain):
    """The same with one opaque sample per ray, but without radiance, density or explanation."""

    def trace(self, rays: Rays) -> Trace:
        one = torch.ones(len(rays), 1)
        samples = Samples("plain", 3 * one, one, 50 * one, one, one, one, self.color.expand(len(rays), 1, 3).clone())
        return Trace(self.render(rays), (samples,))


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    METHODS.names()  # loads the others
    monkeypatch.setitem(METHODS._items, "plain", Plain)
    monkeypatch.setitem(METHODS._items, "sampled", Sampled)


def trained(scene: Scene, method: str) -> Trainer:
    trainer = Trainer(scene, RunSettings(method=method, device="cpu", threads=1))
    losses = [trainer.step().loss for _ in range(10)]
    assert np.mean(losses[5:]) < losses[0]
    return trainer


def test_a_method_without_capabilities_trains_saves_and_renders(scene: Scene) -> None:
    trainer = trained(scene, "plain")
    again = Trainer.resume(scene, trainer.describe(), trainer.state(), "cpu")
    color, _ = render_camera(again.method, scene.views[0].camera, scene)
    np.testing.assert_array_equal(color, render_camera(trainer.frozen_method(), scene.views[0].camera, scene)[0])


def test_without_samples_a_pixel_cannot_be_opened(scene: Scene) -> None:
    with pytest.raises(UserError, match="method plain keeps no samples along a ray: its pixels cannot be opened"):
        open_ray(trained(scene, "plain").method, scene, scene.views[0].camera, (3, 3), 1)


def test_what_an_opened_pixel_lacks_is_reported(scene: Scene) -> None:
    method, camera = trained(scene, "sampled").method, scene.views[0].camera
    opened = open_pixel(method, scene, camera, (8, 8), 10)
    assert opened.radiance is None
    assert opened.verdict is not None
    assert opened.evidence is not None
    assert np.isnan(opened.evidence.emitted).all()
    sentences = [stage.sentence for stage in walk(method, scene, camera, opened.ray)]
    assert any("method sampled does not explain its steps" in sentence for sentence in sentences)
    assert lacking("sampled", "radiance") == "method sampled has no radiance at a point"
    assert lacking("sampled", "trace") == lacking("nerf", "radiance") == lacking("", "radiance") == ""


def test_a_mode_that_needs_a_radiance_says_so(scene: Scene) -> None:
    method = trained(scene, "sampled").method
    assert isinstance(method, Sampled)
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.zeros(2), torch.ones(2))
    with pytest.raises(UserError, match="method sampled has no radiance at a point"):
        shaded(method, rays, method.trace(rays), "view-dependence")


@pytest.mark.parametrize("mode", MODES.names())
def test_every_mode_draws_the_samples_of_a_method_or_says_what_it_lacks(scene: Scene, mode: str) -> None:
    method = trained(scene, "sampled").method
    assert isinstance(method, Sampled)
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.zeros(2), torch.ones(2))
    lack = ""
    try:
        assert shaded(method, rays, method.trace(rays), mode).shape == (2, 3)
    except UserError as error:
        lack = str(error)
    assert lack == "" or "method sampled" in lack
