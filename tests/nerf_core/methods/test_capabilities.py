"""A method that only trains and renders: what it lacks is reported, and nothing breaks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain_methods import Sampled

from nerf_core.common.errors import UserError
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import caption, lacking, traced
from nerf_core.probe import open_pixel, open_ray
from nerf_core.probe.ray import FARTHEST
from nerf_core.probe.walkthrough import walk
from nerf_core.rendering.images import render_camera
from nerf_core.rendering.modes import MODES, obstacle, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("plain_methods")


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


def test_a_pixel_without_samples_is_opened_as_it_was_rendered(scene: Scene) -> None:
    method, camera = trained(scene, "plain").method, scene.views[0].camera
    opened = open_pixel(method, scene, camera, (3, 4), 10)
    ray = opened.ray
    assert ray.passes == ()
    assert len(ray.last.t) == len(ray.visited) == 0
    np.testing.assert_array_equal(ray.color, render_camera(method, camera, scene)[0][4, 3])
    assert (ray.opacity, ray.depth_expected, ray.depth_median) == (1.0, None, None)
    assert opened.verdict is opened.radiance is opened.evidence is None
    assert [stage.title for stage in opened.walk] == ["Camera and pixel", "Ray", "Method", "Pixel", "Photo", "Loss"]


def test_the_places_that_a_method_visits_are_in_its_opened_ray(scene: Scene) -> None:
    method = trained(scene, "visiting").method
    ray = open_ray(method, scene, scene.views[0].camera, (3, 4), 10)
    np.testing.assert_allclose(ray.visited, [1.0, 30.0, 2.5])
    bound = open_ray(trained(scene, "plain").method, scene, scene.views[0].camera, (3, 4), 10).far
    assert (ray.near, ray.far) == (1.0, FARTHEST * np.float32(bound))  # 30 lies behind what any plot shows
    assert ray.depth_expected == 2.5


def test_a_model_of_the_whole_camera_draws_what_it_says(scene: Scene) -> None:
    """A `Posed` model gives another picture for each camera, in whole pictures and for a pixel alone."""
    method, camera = trained(scene, "posed").method, scene.views[1].camera
    assert caption(method, camera) == "camera at " + " ".join(f"{v:.2f}" for v in camera.c2w[:, 3])
    assert caption(trained(scene, "plain").method, camera) == ""
    color, _ = render_camera(method, camera, scene)
    np.testing.assert_array_equal(color, np.broadcast_to(np.float32(abs(camera.c2w[0, 3]) % 1), color.shape))
    np.testing.assert_array_equal(open_ray(method, scene, camera, (3, 4), 1).color, color[4, 3])


def test_a_mode_of_samples_is_refused_for_a_method_that_keeps_none(scene: Scene) -> None:
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.zeros(2), torch.ones(2))
    with pytest.raises(UserError, match="method plain keeps no samples along a ray: it can draw colours alone"):
        traced(trained(scene, "plain").method, rays)


@pytest.mark.parametrize(
    ("method", "mode", "words"),
    [
        ("plain", "colour", ""),
        ("plain", "view-dependence", "method plain keeps no samples along a ray"),
        ("sampled", "view-dependence", "method sampled has no radiance at a point"),
        ("nerf", "view-dependence", ""),
        ("", "view-dependence", ""),
    ],
)
def test_what_keeps_a_method_from_drawing_a_mode_is_known_before(method: str, mode: str, words: str) -> None:
    assert obstacle(method, mode) == words


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
