"""A free camera flies up to and through content: near belongs to the cameras of the capture."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from balls import looking

from nerf_core.datasets.capture import LoadOptions
from nerf_core.datasets.loading import load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.coverage import Coverage
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.view_rays import view_rays
from nerf_core.probe.ray import open_ray
from nerf_core.rendering.images import render_camera, tile_rays
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.sampling import spaced


def every_pixel(camera: Camera) -> np.ndarray:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.stack([columns.ravel(), rows.ravel()], -1)


def towards(camera: Camera, point: np.ndarray, distance: float) -> Camera:
    """The camera moved along the line from its eye to a point, up to a distance in front of it."""
    along = point - camera.c2w[:, 3]
    along /= np.linalg.norm(along)
    return camera.moved(np.concatenate([camera.c2w[:, :3], (point - distance * along)[:, None]], 1))


def test_cameras_of_the_capture_keep_their_bounds_bit_for_bit(scene: Scene) -> None:
    for view in scene.views:
        found, before = (
            view_rays(scene, view.camera, every_pixel(view.camera)),
            camera_rays(view.camera, scene.near, scene.far),
        )
        for name in ("origins", "directions", "near", "far"):
            assert torch.equal(getattr(found, name), getattr(before, name))


def test_rays_of_a_free_camera_begin_at_the_eye_or_where_covered_space_begins(scene: Scene) -> None:
    camera = scene.views[0].camera
    for distance in (1.9, 1.0, 0.0):  # the training rays cover a ball of about this radius
        rays = tile_rays(towards(camera, np.zeros(3), distance), scene, 8 * 16 + 8, 1)
        assert (float(rays.near[0]), float(rays.far[0]) > 1) == (0, True)
    away = towards(camera, np.zeros(3), 12.0)
    rays = tile_rays(away, scene, 8 * 16 + 8, 1)
    assert 12 - 4.5 < float(rays.near[0]) < 12 - 1  # enters between the cameras and the ball
    assert float(rays.far[0]) > 13  # and passes the whole ball, which lies behind the capture's far bound
    behind = camera.moved(np.concatenate([camera.c2w[:, :3] * [-1, 1, -1], 3 * camera.c2w[:, 3:]], 1))
    rays = view_rays(scene, behind, every_pixel(behind))
    assert torch.equal(rays.near, rays.far)  # looks away from everything that was seen: no length


def test_bounds_hold_whichever_pixels_are_asked(scene: Scene) -> None:
    camera = towards(scene.views[0].camera.resized(50, 31), np.zeros(3), 2.7)
    whole, some = view_rays(scene, camera, every_pixel(camera)), tile_rays(camera, scene, 700, 90)
    assert torch.equal(whole.near[700:790], some.near)
    assert torch.equal(whole.far[700:790], some.far)


def test_no_ray_begins_behind_the_first_covered_cell(scene: Scene) -> None:
    camera = towards(scene.views[0].camera.resized(64, 64), np.zeros(3), 7.0)
    rays = view_rays(scene, camera, every_pixel(camera))
    first, last, _ = scene.coverage.crossed(camera.c2w[:, 3], rays.directions.double().numpy())
    some = np.isfinite(first)
    assert some.mean() > 0.3
    assert (rays.near.numpy()[some] <= first[some] + scene.coverage.side).all()
    assert (rays.far.numpy()[some] >= last[some] - scene.coverage.side).all()


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.31, 0.17), (-0.25, 0.08)])
def test_no_ray_misses_what_is_small_from_far_away(scene: Scene, shift: tuple[float, float]) -> None:
    """The space may lie between the few pixels at which bounds are computed."""
    for distance in (20.0, 40.0, 60.0, 150.0, 400.0):
        camera = towards(scene.views[0].camera.resized(160, 160), np.zeros(3), distance)
        turned = camera.c2w[:, :3] @ [*shift, -1.0] * distance  # what the eye now has in the middle of its picture
        camera = camera.moved(np.column_stack([camera.c2w[:, :3], -turned + 0.02]))
        directions = np.random.default_rng(0).normal(size=(300, 3))
        ball = 0.9 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        pixels, depth = camera.project(ball)
        inside = ((pixels >= 0) & (pixels < 160)).all(-1) & (depth > 0)
        rays = view_rays(scene, camera, pixels[inside].astype(int))
        away = np.linalg.norm(ball[inside] - camera.c2w[:, 3], axis=-1)
        assert inside.all()
        assert (rays.near.numpy() <= away).all()
        assert (rays.far.numpy() >= away).all()
        assert (rays.far - rays.near).max() < 30  # and not from the eye on


def test_space_before_a_photo_s_near_bound_is_empty_whatever_others_see_there() -> None:
    """Two cameras face each other across the origin. Each sees the space before the other, which is empty."""
    cameras = [looking((4.0, 0.0, 0.0)), looking((-4.0, 0.0, 0.0))]
    found = Coverage.of(cameras, 3.0, 9.0, np.zeros(3), 1.0)
    line = np.array([[-1.0, 0.0, 0.0]])
    for eye in ((4.0, 0.0, 0.0), (4.5, 0.0, 0.0), (3.0, 0.1, 0.1)):
        first, last, _ = found.crossed(np.array(eye), line)
        assert eye[0] - first[0] == pytest.approx(1, abs=1.5 * found.side)  # begins at x = 1
        assert eye[0] - last[0] == pytest.approx(-1, abs=2 * found.side)
    assert found.crossed(np.array((0.5, 0.0, 0.0)), line)[0][0] == 0
    beside = found.crossed(np.array((3.5, 0.0, 2.0)), np.array([[-1.0, 0.0, 0.0]]))[0]
    assert beside[0] == pytest.approx(0, abs=1.6)  # out of the first camera's picture, the other's view counts


@pytest.mark.parametrize("count", [100, 10_000])
def test_coverage_is_quick_for_many_views(scene: Scene, count: int) -> None:
    cameras = [scene.views[i % 5].camera for i in range(count)]
    times = []
    for _ in range(5):
        begin = time.process_time()
        Coverage.of(cameras, scene.near, scene.far, scene.center, scene.radius)
        times.append(time.process_time() - begin)
    assert min(times) < (0.1 if count == 100 else 0.2)


def test_disparity_spacing_from_the_eye_keeps_the_trained_steps() -> None:
    near, far = torch.tensor([2.0, 2.5, 0.0]), torch.tensor([60.0, 60.0, 60.0])
    known, shifted = spaced(near, far, 64, True), spaced(near, far, 64, True, 2.0)
    assert torch.equal(known[:2], shifted[:2])  # those of training: bit for bit
    assert float(shifted[2, 0]) == 0
    first = shifted.diff()[:, 0]
    assert float(first[2]) == pytest.approx(float(first[0]), rel=0.01)


@pytest.mark.parametrize("method", ["nerf", "nerf-guided", "hash"])
def test_every_method_draws_within_content(scene: Scene, method: str, make_trainer: Callable[..., Trainer]) -> None:
    trainer = (
        make_trainer() if method == "nerf" else Trainer(scene, RunSettings(LoadOptions(), method, steps=20, threads=1))
    )
    for _ in range(3):
        trainer.step()
    for place in (scene, replace(scene, synthetic=False, disparity=True)):
        for distance in (1.5, 0.5, 0.0, -0.5, -3.0):
            camera = towards(scene.views[0].camera, np.array([0, 0, 0.1]), distance)
            color, _ = render_camera(trainer.method, camera, place)
            assert np.isfinite(color).all()
            assert np.isfinite(open_ray(trainer.method, place, camera, (8, 8), 3).color).all()


@pytest.mark.parametrize(
    ("method", "steps"), [pytest.param("voxels", 140, marks=pytest.mark.thorough(8)), ("hash", 200)]
)
def test_flying_up_to_the_demo_ball_keeps_its_picture(method: str, steps: int) -> None:
    demo = load_scene(None, LoadOptions(max_size=64))
    trainer = Trainer(demo, RunSettings(LoadOptions(), method, threads=1))
    for _ in range(steps):
        trainer.step()
    camera = demo.views[demo.split("train")[0]].camera
    pixel = int(0.43 * camera.width), int(0.59 * camera.height)
    seen = open_ray(trainer.method, demo, camera, pixel, steps)
    assert seen.depth_median is not None
    assert seen.begins == "the photos' near bound"
    assert seen.opacity > 0.9
    point = seen.origin + seen.depth_median * seen.direction
    for distance in (3.0, 2.0, 1.9, 1.5, 1.0, 0.6, 0.4):
        ray = open_ray(trainer.method, demo, towards(camera, point.astype(np.float64), distance), pixel, steps)
        assert ray.opacity >= 0.9
        np.testing.assert_allclose(ray.color, seen.color, atol=0.05)  # the same ray, from nearer
        assert ray.begins == ("the eye" if ray.near == 0 else "where photos begin to show the space")
        assert ray.begins == "the eye" or distance > 1
    for distance in (0.1, 0.0, -0.1, -0.5, -2.0, -5.0):  # into the surface, through it and out on the other side
        color, _ = render_camera(trainer.method, towards(camera, point.astype(np.float64), distance), demo)
        assert np.isfinite(color).all()
