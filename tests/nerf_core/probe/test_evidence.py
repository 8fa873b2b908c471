"""What the training views observe of a point, compared with brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from balls import Ball, Balls, model_of, ring_scene
from panel_states import make_scene

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.scene import Scene
from nerf_core.probe import TrainingViews, mean_emitted
from nerf_core.probe.sightings import unseen

BALL = Ball((0.0, 0.0, 0.0), 0.7, (0.5, 0.3, 0.2), gloss=0.2)
SIDE = 0.7 * np.array([0.8, 0.0, 0.6])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(BALL)


def test_a_point_is_framed_where_the_camera_projects_it_into_the_photo() -> None:
    """Compares with each camera's own projection, lens included. Some cameras look away; one lies at the last point."""
    scene, rng = make_scene(), np.random.default_rng(3)
    bent = tuple(replace(view, camera=replace(view.camera, lens=Lens(k1=0.3, p1=0.02))) for view in scene.views)
    training_views = TrainingViews(replace(scene, views=bent))
    for point in [*rng.normal(scale=1.5, size=(20, 3)), bent[scene.split("train")[0]].camera.c2w[:, 3]]:
        pixels, framed = training_views.project(point)
        for k, i in enumerate(scene.split("train")):
            camera = bent[i].camera
            (pixel,), (depth,) = camera.project(point[None])
            inside = 0 <= pixel[0] < camera.width and 0 <= pixel[1] < camera.height
            assert framed[k] == (depth > 0 and inside)
            if framed[k]:
                np.testing.assert_allclose(pixels[k], pixel, atol=1e-9)
        assert np.isfinite(pixels).all()


def test_a_choice_of_many_photos_keeps_the_nearest_and_covers_all_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """40 of 120 photos are used. They include the nearest in angle, and no photo's direction counts as unseen."""
    monkeypatch.setattr("nerf_core.probe.evidence.MOST_VIEWS", 40)
    scene = ring_scene(BALL, count=120, size=8)
    look, air = -SIDE / np.linalg.norm(SIDE), np.array([0.0, 0.0, 0.9])  # above the ball, where every photo sees it
    asked = TrainingViews(scene).look(model_of(scene, BALL), air, look, 0.05)
    assert (asked.framed, len(asked.views), len(np.unique(asked.views))) == (120, 40, 40)
    monkeypatch.setattr("nerf_core.probe.evidence.MOST_VIEWS", 120)
    everything = TrainingViews(scene).look(model_of(scene, BALL), air, look, 0.05)
    assert everything.seen.all()
    assert set(everything.views[np.argsort(everything.angle)][:20]) <= set(asked.views)
    assert not unseen(everything.directions, asked).any()


def test_a_point_that_the_lens_folds_into_the_frame_is_not_framed() -> None:
    """A barrel lens's polynomial turns back far outside the picture. Rays through the pixel it gives look elsewhere."""
    camera = Camera(800, 600, 600.0, 600.0, 400.0, 300.0, np.eye(4)[:3], Lens(k1=-0.28))
    scene = make_scene()
    views = (replace(scene.views[0], camera=camera),)
    training_views = TrainingViews(replace(scene, views=views, photos=scene.photos.at([0]), splits={"train": (0,)}))
    for degrees, seen in ((10, True), (25, True), (62, False), (65, False), (80, False)):
        angle = np.radians(degrees)
        look = np.array([np.sin(angle), 0.0, -np.cos(angle)])
        pixels, framed = training_views.project(3 * look)
        assert bool(framed[0]) == seen
        (alone,), (depth,) = camera.project(3 * look[None])
        assert (0 <= alone[0] < 800 and 0 <= alone[1] < 600) == seen
        assert depth > 0
        ray = training_views.rays(np.array([0]), np.clip(pixels, 0, (799, 599))).directions[0].numpy()
        assert not seen or ray @ look > np.cos(np.radians(0.1))


def test_the_near_side_is_seen_from_the_near_side(scene: Scene) -> None:
    """Exactly the cameras above the tangent plane of a point of the ball see it, except at grazing angles."""
    point, look = np.array([0.7, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])
    found = TrainingViews(scene).look(model_of(scene, BALL), point, look, 0.05)
    eyes = np.array([scene.views[i].camera.c2w[:, 3] for i in found.views])
    lean = (eyes - point)[:, 0] / np.linalg.norm(eyes - point, axis=1)
    assert found.asked == 24
    assert found.framed == len(found.views) == 24
    assert found.seen[lean > 0.3].all()
    assert not found.seen[lean < -0.1].any()
    order = np.arange(len(found.views))
    assert (order[found.seen].max() < order[~found.seen].min()) or found.seen.all()
    assert (np.diff(found.angle[found.seen]) >= 0).all()
    np.testing.assert_allclose(np.cos(found.angle), (-found.directions) @ look, atol=1e-12)


def test_transmittance_is_the_integral_of_the_density(scene: Scene) -> None:
    """T = exp(−∫σ dt) from the camera to 0.1 before the point. The ball is thin, so that all values occur."""
    thin = replace(BALL, density=2.0)
    point, method = np.array([0.0, 0.3, 0.2]), model_of(scene, thin)
    found = TrainingViews(scene).look(method, point, np.array([0.0, 1.0, 0.0]), 0.1)
    field = Balls((thin,))
    for k in range(0, len(found.views), 5):
        camera = scene.views[found.views[k]].camera
        rays = TrainingViews(scene).rays(found.views[k : k + 1], found.pixels[k : k + 1])
        np.testing.assert_allclose(rays.origins[0], camera.c2w[:, 3], atol=1e-6)
        t = torch.linspace(float(rays.near[0]), float(found.distance[k]) - 0.1, 20_000)
        sigma = torch.relu(field.geometry(rays.origins[0] + t[:, None] * rays.directions[0])[0])
        assert found.transmittance[k] == pytest.approx(float(torch.exp(-torch.trapezoid(sigma, t))), abs=0.02)


def test_observed_predicted_and_emitted_colours(scene: Scene) -> None:
    method = model_of(scene, BALL)
    found = TrainingViews(scene).look(method, SIDE, -SIDE / 0.7, 0.05)
    for k, view in enumerate(found.views):
        column, row = np.floor(found.pixels[k]).astype(int)
        np.testing.assert_allclose(found.observed[k], scene.images[view][row, column] / 65535, atol=1e-6)
    np.testing.assert_allclose(found.observed, found.predicted, atol=1e-4)  # the photos were rendered from the model
    expected = np.clip(np.array(BALL.color) - BALL.gloss * found.directions, 0, 1)
    np.testing.assert_allclose(found.emitted, expected, atol=1e-5)


def test_the_mean_colour_is_that_emitted_to_the_photos_that_see_the_point(scene: Scene) -> None:
    """The ball shows each camera its colour minus gloss times the direction to the camera."""
    found = TrainingViews(scene).look(model_of(scene, BALL), SIDE, -SIDE / 0.7, 0.05)
    mean = mean_emitted(found)
    assert mean is not None
    towards = np.array([scene.views[i].camera.c2w[:, 3] for i in found.views]) - SIDE
    shown = np.array(BALL.color) - BALL.gloss * towards / np.linalg.norm(towards, axis=1)[:, None]
    np.testing.assert_allclose(mean, shown[found.seen].mean(0), atol=1e-6)
    assert (np.abs(mean - shown.mean(0)) > 1e-3).any()  # cameras behind the ball do not count
    assert mean_emitted(found.at(np.arange(2))) is None


def test_without_the_near_ball_the_far_one_is_seen(scene: Scene) -> None:
    near = Ball((1.6, 0.0, 0.4), 0.2, (0.1, 0.1, 0.9))
    method, training_views = model_of(scene, BALL, near), TrainingViews(scene)
    point = np.array([1.8, 0.0, 0.4])
    # the margin of 0.15 is wide because the ball's rim is soft
    found = training_views.look(method, point, np.array([-1.0, 0.0, 0.0]), 0.15)
    asked = found.at(found.seen & (found.share > 0.5))
    assert len(asked.views) >= 3
    without, opaque, bare = training_views.otherwise(method, asked, np.array([-0.15, 0.6]))
    np.testing.assert_allclose(without[1], asked.observed, atol=0.03)  # the photos show no near ball
    assert np.abs(without[0] - asked.observed).mean() > 0.2  # the reach −0.15 takes nothing out
    np.testing.assert_allclose(without[0], asked.predicted, atol=0.05)
    np.testing.assert_allclose(opaque, asked.emitted, atol=0.05)
    np.testing.assert_allclose(bare, 1.0, atol=0.05)  # the white background alone


def test_opaque_is_what_is_seen_when_no_background_shows(scene: Scene) -> None:
    """A hollow ball transmits half of the background. `opaque` is the ball's own colour, not half white."""
    thin = model_of(scene, replace(BALL, density=6.0, skin=0.05, gloss=0.0))
    training_views = TrainingViews(scene)
    found = training_views.look(thin, np.array([0.75, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 0.1)
    asked = found.at(found.seen & (found.share > 0.1) & (found.angle < 1.0))
    assert len(asked.views) >= 3
    _, opaque, _ = training_views.otherwise(thin, asked, np.array([0.2]))
    assert np.abs(asked.predicted - BALL.color).mean() > 0.08
    np.testing.assert_allclose(opaque, np.broadcast_to(BALL.color, opaque.shape), atol=0.02)


def test_no_training_photo_sees_a_point_behind_all_cameras(scene: Scene) -> None:
    training_views = TrainingViews(scene)
    found = training_views.look(model_of(scene, BALL), np.array([0.0, 0.0, 50.0]), np.array([0.0, 0.0, 1.0]), 0.05)
    assert (found.framed, len(found.views), found.asked) == (0, 0, 24)
    without, opaque, bare = training_views.otherwise(model_of(scene, BALL), found, np.array([1.0]))
    assert (without.shape, opaque.shape, bare.shape) == ((1, 0, 3), (0, 3), (0, 3))
    no_views = TrainingViews(replace(scene, splits={}))
    assert no_views.look(model_of(scene, BALL), SIDE, -SIDE / 0.7, 0.05).asked == 0


def test_a_photo_that_has_the_point_masked_says_nothing(scene: Scene) -> None:
    model, look = model_of(scene, BALL), -SIDE / 0.7
    before = TrainingViews(scene).look(model, SIDE, look, 0.05)
    view = int(before.views[0])
    width, height = scene.photos.sizes[view]
    mask = np.ones((height, width), bool)
    x, y = np.floor(before.pixels[0]).astype(int)
    mask[y, x] = False
    found = TrainingViews(replace(scene, photos=scene.photos.masked({view: mask}))).look(model, SIDE, look, 0.05)
    assert view not in found.views
    assert (found.masked, found.framed, found.asked) == (1, before.framed - 1, before.asked)
    assert before.masked == 0


def test_photos_are_compared_as_of_the_mean_exposure(scene: Scene) -> None:
    model, look = model_of(scene, BALL), -SIDE / 0.7
    before = TrainingViews(scene).look(model, SIDE, look, 0.05)
    view = int(before.views[0])
    learnt = {view: (np.array([0.5, 1.0, 2.0], np.float32), np.array([0.1, 0.0, 0.0], np.float32))}
    found = TrainingViews(scene, learnt).look(model, SIDE, look, 0.05)
    expected = np.clip((before.observed[0] - [0.1, 0, 0]) / [0.5, 1, 2], 0, 1)
    np.testing.assert_allclose(found.observed[0], expected, atol=1e-6)
    np.testing.assert_array_equal(found.gain[0], [0.5, 1, 2])
    np.testing.assert_array_equal(found.observed[1:], before.observed[1:])
