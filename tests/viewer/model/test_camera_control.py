"""The user's camera: the effect of each movement, and that no sequence of movements breaks it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.geometry.turntable import angles_from, rotation_from
from viewer.model.camera_control import MAX_ELEVATION, MOVING_SECONDS, CameraControl

WIDTH, HEIGHT = 640, 400
UP = np.array([0.0, -1.0, 0.3])
CENTER = np.array([0.4, 0.2, -0.3])


def photo(azimuth: float, elevation: float, roll: float, distance: float = 3.0) -> Camera:
    rotation = rotation_from(azimuth, elevation, roll, UP)
    pose = np.column_stack([rotation, CENTER + distance * rotation[:, 2]])
    return Camera(80, 60, 70.0, 65.0, 40.0, 30.0, pose)


def make_scene(radius: float = 1.0, ndc: Ndc | None = None) -> Scene:
    cameras = [photo(0.3 + k, 0.2, 0.1, 3 * radius) for k in range(5)]
    return Scene(
        name="made",
        format="blender",
        views=tuple(View(f"{i}.png", camera) for i, camera in enumerate(cameras)),
        photos=Photos.of([np.zeros((60, 80, 3), np.uint16) for _ in cameras]),
        splits={"train": (1, 2, 3, 4), "test": (0,)},
        near=0.5 * radius,
        far=6 * radius,
        background=(1.0, 1.0, 1.0),
        center=CENTER,
        radius=radius,
        up=UP,
        to_input=np.eye(4),
        synthetic=True,
        ndc=ndc,
    )


def control(scene: Scene | None = None) -> CameraControl:
    camera = CameraControl()
    camera.set_scene(scene or make_scene())
    camera.update(0.0)
    return camera


def finish(camera: CameraControl) -> None:
    camera.update(10.0)
    assert camera.update(10.3)
    assert not camera.update(10.4)


def pixel(camera: CameraControl, point: np.ndarray) -> np.ndarray:
    return camera.camera(WIDTH, HEIGHT).project(point[None])[0][0]


def under(camera: CameraControl, x: float, y: float, depth: float) -> np.ndarray:
    """The world point at pixel (x, y) and z-depth `depth`."""
    view = camera.camera(WIDTH, HEIGHT)
    local = np.array([(x - view.cx) / view.fx, -(y - view.cy) / view.fy, -1.0]) * depth
    return view.c2w[:, :3] @ local + view.c2w[:, 3]


def assert_level(camera: CameraControl) -> None:
    assert camera.c2w()[:, 0] @ UP == pytest.approx(0, abs=1e-9)
    assert camera.c2w()[:, 1] @ UP > 0


def test_works_without_a_scene() -> None:
    camera = CameraControl()
    assert camera.c2w().shape == (3, 4)
    assert camera.c2w().dtype == np.float64
    np.testing.assert_allclose(pixel(camera, np.zeros(3)), [WIDTH / 2, HEIGHT / 2])
    assert not camera.update(0.0)
    assert not camera.moving(0.0)
    camera.frame()
    finish(camera)


def test_starts_at_the_first_training_photo_level() -> None:
    camera, first = control(), make_scene().views[1].camera
    np.testing.assert_allclose(camera.c2w()[:, 2:], first.c2w[:, 2:], atol=1e-12)
    np.testing.assert_allclose(camera.pivot, CENTER, atol=1e-12)
    assert camera.fov_y_degrees == pytest.approx(2 * math.degrees(math.atan(30 / 65)))
    assert_level(camera)


def test_starts_at_the_most_central_photo_of_a_photographed_place() -> None:
    """Of five cameras in a row, of which the last is turned away, the third is the most similar to all."""
    views = [photo(azimuth, 0.2, 0.1) for azimuth in (0.0, 0.2, 0.4, 0.6, 3.0)]
    scene = replace(
        make_scene(), synthetic=False, views=tuple(View(str(i), c) for i, c in enumerate(views)),
        splits={"train": (0, 1, 2, 3, 4)},
    )  # fmt: skip
    np.testing.assert_allclose(control(scene).c2w()[:, 3], views[2].c2w[:, 3], atol=1e-12)


def test_starts_on_an_orbit_without_training_photos() -> None:
    camera = control(replace(make_scene(), splits={}))
    np.testing.assert_allclose(pixel(camera, CENTER), [WIDTH / 2, HEIGHT / 2])
    assert_level(camera)


@pytest.mark.parametrize(("width", "height"), [(640, 400), (300, 900), (1, 1)])
def test_the_vertical_field_of_view_does_not_depend_on_the_window(width: int, height: int) -> None:
    camera = control()
    view = camera.camera(width, height)
    assert math.degrees(2 * math.atan(height / 2 / view.fy)) == pytest.approx(camera.fov_y_degrees)
    assert (view.fx, view.cx, view.cy) == (view.fy, width / 2, height / 2)


@given(st.floats(-5000, 5000), st.floats(-5000, 5000))
def test_orbit_keeps_the_pivot_and_never_flips(dx: float, dy: float) -> None:
    camera = control()
    pivot, distance = camera.pivot, camera.distance
    camera.orbit(dx, dy, HEIGHT)
    assert np.linalg.norm(camera.c2w()[:, 3] - pivot) == pytest.approx(distance)
    np.testing.assert_allclose(pixel(camera, pivot), [WIDTH / 2, HEIGHT / 2])
    assert abs(angles_from(camera.c2w()[:, :3], UP)[1]) <= MAX_ELEVATION + 1e-9
    assert_level(camera)


def test_orbit_follows_the_pointer() -> None:
    """A point in front of the pivot moves with the pointer, because the camera moves the other way."""
    camera = control()
    near = under(camera, WIDTH / 2, HEIGHT / 2, camera.distance - 0.5)
    camera.orbit(20, 12, HEIGHT)
    x, y = pixel(camera, near)
    assert x > WIDTH / 2
    assert y > HEIGHT / 2


def test_a_photos_roll_fades_while_orbiting() -> None:
    camera = control()
    camera.go_to(photo(1.0, 0.3, 0.8))
    finish(camera)
    camera.orbit(1, 0, HEIGHT)
    assert angles_from(camera.c2w()[:, :3], UP)[2] == pytest.approx(0.8, abs=0.1)
    for _ in range(HEIGHT):
        camera.orbit(1, 0, HEIGHT)
    assert_level(camera)


@given(st.floats(0, WIDTH), st.floats(0, HEIGHT), st.floats(-300, 300), st.floats(-300, 300))
def test_pan_moves_the_pixel_with_the_pointer(x: float, y: float, dx: float, dy: float) -> None:
    camera = control()
    point = under(camera, x, y, camera.distance)
    camera.pan(dx, dy, HEIGHT)
    np.testing.assert_allclose(pixel(camera, point), [x + dx, y + dy], atol=1e-6)


@given(st.floats(0, WIDTH), st.floats(0, HEIGHT), st.floats(-200, 200))
def test_zoom_keeps_the_point_under_the_pointer(x: float, y: float, steps: float) -> None:
    camera = control()
    distance = camera.distance
    point = under(camera, x, y, distance)
    camera.zoom(steps, x, y, WIDTH, HEIGHT)
    np.testing.assert_allclose(pixel(camera, point), [x, y], atol=1e-6)
    assert camera.distance > 0
    assert (camera.distance < distance) == (steps > 0) or camera.distance == pytest.approx(distance)
    assert camera.camera(WIDTH, HEIGHT).project(point[None])[1][0] == pytest.approx(camera.distance)


def test_fly() -> None:
    camera = control()
    start = camera.c2w()
    camera.fly(0, 0, 1, 0.1)
    step = camera.c2w()[:, 3] - start[:, 3]
    np.testing.assert_allclose(step / np.linalg.norm(step), -start[:, 2])
    camera.fly(0, 1, 0, 0.1, fast=True)
    rise = camera.c2w()[:, 3] - start[:, 3] - step
    np.testing.assert_allclose(rise / np.linalg.norm(rise), UP / np.linalg.norm(UP))
    assert np.linalg.norm(rise) == pytest.approx(5 * np.linalg.norm(step))
    large = control(make_scene(radius=10))
    origin = large.c2w()[:, 3]
    large.fly(1, 0, 1, 0.1)
    assert np.linalg.norm(large.c2w()[:, 3] - origin) == pytest.approx(10 * np.linalg.norm(step))
    before = large.c2w()
    large.fly(0, 0, 0, 0.1)
    np.testing.assert_array_equal(large.c2w(), before)


def test_a_slow_frame_does_not_make_a_leap() -> None:
    short, long = control(), control()
    short.fly(0, 0, 1, 0.1)
    long.fly(0, 0, 1, 60.0)
    np.testing.assert_array_equal(short.c2w(), long.c2w())


vectors = st.tuples(*[st.floats(-50, 50)] * 3).map(np.array)


@given(vectors)
def test_focus_puts_the_point_at_the_centre(point: np.ndarray) -> None:
    camera = control()
    eye = camera.c2w()[:, 3]
    camera.focus(point)
    finish(camera)
    np.testing.assert_allclose(pixel(camera, point), [WIDTH / 2, HEIGHT / 2], atol=1e-6)
    np.testing.assert_allclose(camera.pivot, point, atol=1e-9)
    if np.linalg.norm(point - eye) > 0.01:
        np.testing.assert_array_equal(camera.c2w()[:, 3], eye)
    camera.orbit(30, 0, HEIGHT)
    np.testing.assert_allclose(camera.pivot, point, atol=1e-9)


def test_focus_straight_up_at_the_eye_and_at_nothing() -> None:
    camera = control()
    eye = camera.c2w()[:, 3]
    before = camera.c2w()
    camera.focus(np.array([np.nan, 0, 0]))
    assert not camera.update(1.0)
    np.testing.assert_array_equal(camera.c2w(), before)
    for point in (eye + UP, eye - UP, eye):
        camera.focus(point)
        finish(camera)
        np.testing.assert_allclose(pixel(camera, point), [WIDTH / 2, HEIGHT / 2], atol=1e-6)


def test_frame_shows_the_centre_from_the_present_side() -> None:
    camera = control()
    camera.orbit(200, 40, HEIGHT)
    side = camera.c2w()[:, :3]
    camera.pan(500, 20, HEIGHT)
    camera.zoom(-20, 3, 4, WIDTH, HEIGHT)
    camera.frame()
    finish(camera)
    np.testing.assert_allclose(camera.c2w()[:, :3], side, atol=1e-12)
    np.testing.assert_allclose(camera.pivot, CENTER, atol=1e-12)
    assert camera.distance == pytest.approx(3.0)


def test_reset_and_frame_of_a_forward_facing_scene() -> None:
    camera = control(make_scene(ndc=Ndc(80, 60, 65.0, 0.5, 6.0)))
    home = camera.c2w()
    assert (camera.pivot - home[:, 3]) @ home[:, 2] < 0
    for back in (camera.reset, camera.frame):
        camera.orbit(900, -70, HEIGHT)
        camera.fly(1, 1, 1, 0.1)
        back()
        finish(camera)
        np.testing.assert_array_equal(camera.c2w(), home)


@pytest.mark.parametrize("elevation", [0.2, math.pi / 2, -math.pi / 2])
def test_go_to_is_the_photos_camera_exactly(elevation: float) -> None:
    camera, wanted = control(), photo(2.2, elevation, -0.4)
    camera.go_to(wanted)
    finish(camera)
    np.testing.assert_array_equal(camera.c2w(), wanted.c2w)
    view = camera.camera(wanted.width, wanted.height)
    assert view.fy == pytest.approx(wanted.fy)
    camera.orbit(0.01, 0, HEIGHT)
    assert np.abs(camera.c2w() - wanted.c2w).max() < 0.1


def test_go_to_a_photo_that_looks_away() -> None:
    camera = control()
    away = photo(0.0, 0.1, 0.0, distance=-2.0)
    camera.go_to(away)
    finish(camera)
    assert camera.distance == pytest.approx(1.0)


def test_a_jump_eases_for_200_ms() -> None:
    camera, wanted = control(), photo(2.2, 0.5, -0.4)
    start = camera.c2w()
    camera.go_to(wanted)
    distances = []
    for time in (5.0, 5.05, 5.1, 5.15, 5.2):
        assert camera.update(time)
        distances.append(float(np.linalg.norm(camera.c2w() - wanted.c2w)))
    assert distances[0] == pytest.approx(np.linalg.norm(start - wanted.c2w))
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] == 0
    assert not camera.update(5.21)


def test_a_turn_on_the_spot_keeps_the_eye_and_every_jump_stays_upright() -> None:
    camera = control()
    eye = camera.c2w()[:, 3]
    camera.focus(CENTER + 2)
    for time in (0.0, 0.05, 0.1, 0.15):
        camera.update(time)
        np.testing.assert_array_equal(camera.c2w()[:, 3], eye)
        assert_level(camera)


def test_input_stops_a_jump() -> None:
    camera = control()
    camera.go_to(photo(2.2, 0.5, -0.4))
    camera.update(1.0)
    camera.update(1.1)
    camera.pan(1, 0, HEIGHT)
    there = camera.c2w()
    assert camera.update(1.15)
    np.testing.assert_array_equal(camera.c2w(), there)


def test_moving_lasts_a_moment() -> None:
    camera = control()
    camera.update(5.0)
    assert not camera.moving(5.0)
    camera.orbit(1, 0, HEIGHT)
    assert camera.update(6.0)
    assert camera.moving(6.0 + 0.9 * MOVING_SECONDS)
    assert not camera.update(6.1)
    assert not camera.moving(6.0 + 1.1 * MOVING_SECONDS)


pixels = st.floats(-3000, 3000)
events = st.one_of(
    st.tuples(st.just("orbit"), pixels, pixels, st.just(HEIGHT)),
    st.tuples(st.just("pan"), pixels, pixels, st.just(HEIGHT)),
    st.tuples(st.just("zoom"), st.floats(-50, 50), pixels, pixels, st.just(WIDTH), st.just(HEIGHT)),
    st.tuples(st.just("fly"), *[st.integers(-1, 1)] * 3, st.floats(0, 1), st.booleans()),
    st.tuples(st.just("focus"), vectors),
    st.tuples(st.just("focus"), st.just(np.full(3, np.nan))),
    st.tuples(st.just("go_to"), st.builds(photo, pixels, st.floats(-math.pi / 2, math.pi / 2), pixels)),
    st.tuples(st.just("frame")),
    st.tuples(st.just("reset")),
)


@settings(deadline=None)
@given(st.sampled_from([0.0, 1e-9, 1.0, 1e9]), st.lists(st.tuples(events, st.floats(0, 0.3)), max_size=25))
def test_no_sequence_breaks_the_camera(radius: float, sequence: list[tuple[tuple, float]]) -> None:
    scene = make_scene()
    camera = control(replace(scene, radius=radius))
    time = 0.0
    for (name, *arguments), pause in sequence:
        getattr(camera, name)(*arguments)
        time += pause
        camera.update(time)
        pose = camera.c2w()
        assert np.isfinite(pose).all()
        assert np.isfinite(camera.camera(WIDTH, HEIGHT).intrinsics()).all()
        np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:, :3]) > 0
        assert camera.distance > 0
