"""What photos know of a point, against brute force."""

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
from nerf_core.probe import TrainingViews, diffuse_of
from nerf_core.probe.sightings import unseen

BALL = Ball((0.0, 0.0, 0.0), 0.7, (0.5, 0.3, 0.2), gloss=0.2)
SIDE = 0.7 * np.array([0.8, 0.0, 0.6])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(BALL)


def test_photos_that_have_the_point_in_their_frame_are_told_from_the_others() -> None:
    """Against the cameras' own projection, lens and all; some look away from the point, one stands in it."""
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


def test_of_very_many_photos_those_are_asked_that_look_from_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as one likes: what one of them looked at from nearby is no extrapolation."""
    monkeypatch.setattr("nerf_core.probe.evidence.MOST_VIEWS", 40)
    scene = ring_scene(BALL, count=120, size=8)
    look, air = -SIDE / np.linalg.norm(SIDE), np.array([0.0, 0.0, 0.9])  # above the ball: every photo sees that
    asked = TrainingViews(scene).look(model_of(scene, BALL), air, look, 0.05)
    assert (asked.framed, len(asked.views), len(np.unique(asked.views))) == (120, 40, 40)
    monkeypatch.setattr("nerf_core.probe.evidence.MOST_VIEWS", 120)
    everybody = TrainingViews(scene).look(model_of(scene, BALL), air, look, 0.05)
    assert everybody.seen.all()
    assert set(everybody.views[np.argsort(everybody.angle)][:20]) <= set(asked.views)
    assert not unseen(everybody.directions, asked).any()


def test_what_a_lens_folds_into_the_frame_is_not_in_it() -> None:
    """A barrel lens's polynomial turns back far outside of the picture: a ray through that pixel looks elsewhere."""
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
    """Of a point of the ball just those cameras see it that stand above its tangent plane, but for grazing looks."""
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


def test_light_is_what_the_density_lets_through(scene: Scene) -> None:
    """exp(−∫σ) from the camera to the margin, integrated finely; the field is thin, so that all values occur."""
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


def test_colours_are_the_photos_the_models_and_the_points(scene: Scene) -> None:
    method = model_of(scene, BALL)
    found = TrainingViews(scene).look(method, SIDE, -SIDE / 0.7, 0.05)
    for k, view in enumerate(found.views):
        column, row = np.floor(found.pixels[k]).astype(int)
        np.testing.assert_allclose(found.observed[k], scene.images[view][row, column] / 65535, atol=1e-6)
    np.testing.assert_allclose(found.observed, found.predicted, atol=1e-4)  # the model is what took the photos
    expected = np.clip(np.array(BALL.color) - BALL.gloss * found.directions, 0, 1)
    np.testing.assert_allclose(found.emitted, expected, atol=1e-5)


def test_diffuse_is_what_every_photo_is_shown(scene: Scene) -> None:
    """Of a ball that shows every camera its colour less a share of the direction to it."""
    found = TrainingViews(scene).look(model_of(scene, BALL), SIDE, -SIDE / 0.7, 0.05)
    diffuse = diffuse_of(found)
    assert diffuse is not None
    towards = np.array([scene.views[i].camera.c2w[:, 3] for i in found.views]) - SIDE
    shown = np.array(BALL.color) - BALL.gloss * towards / np.linalg.norm(towards, axis=1)[:, None]
    np.testing.assert_allclose(diffuse, shown[found.seen].min(0), atol=1e-6)
    assert (diffuse > shown.min(0) + 1e-3).any()  # not what it would show those behind it
    assert diffuse_of(found.at(np.arange(2))) is None


def test_without_the_near_ball_the_far_one_is_seen(scene: Scene) -> None:
    near = Ball((1.6, 0.0, 0.4), 0.2, (0.1, 0.1, 0.9))
    method, training_views = model_of(scene, BALL, near), TrainingViews(scene)
    point = np.array([1.8, 0.0, 0.4])
    found = training_views.look(method, point, np.array([-1.0, 0.0, 0.0]), 0.15)  # a rim is soft
    asked = found.at(found.seen & (found.share > 0.5))
    assert len(asked.views) >= 3
    without, opaque, bare = training_views.otherwise(method, asked, np.array([-0.15, 0.6]))
    np.testing.assert_allclose(without[1], asked.observed, atol=0.03)  # the photos know of no near ball
    assert np.abs(without[0] - asked.observed).mean() > 0.2  # where nothing is taken out it is still there
    np.testing.assert_allclose(without[0], asked.predicted, atol=0.05)
    np.testing.assert_allclose(opaque, asked.emitted, atol=0.05)
    np.testing.assert_allclose(bare, 1.0, atol=0.05)  # white, with nothing in front of it


def test_opaque_is_what_is_seen_when_no_background_shows(scene: Scene) -> None:
    """Of a hollow ball that lets half of the light through, its own colour, not half white."""
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
    nobody = TrainingViews(replace(scene, splits={}))
    assert nobody.look(model_of(scene, BALL), SIDE, -SIDE / 0.7, 0.05).asked == 0
