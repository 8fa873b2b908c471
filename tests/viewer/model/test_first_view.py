"""The first view of captures whose cameras stand in different ways: upright, at its subject, at a sensible distance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arrangements import OBJECT, ROOM, SIZE, UP, Arrangement, arrangements, draw, in_world, outward, ring

from nerf_core.datasets.capture import LoadOptions
from nerf_core.datasets.geometry import normalise
from nerf_core.datasets.rig import up_direction
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from viewer.model.camera_control import FLY_SPEED, CameraControl
from viewer.model.first_view import most_central

KINDS = arrangements()
POINTS = pytest.mark.parametrize("points", [True, False], ids=["points", "no points"])
EVERY = pytest.mark.parametrize("kind", KINDS)


def scene_of(arrangement: Arrangement, points: bool = True) -> Scene:
    capture = arrangement.capture(points)
    done = normalise(capture, LoadOptions())
    return Scene(
        name="made", format="colmap", views=tuple(map(View, [p.name for p in capture.photos], done.cameras)),
        photos=Photos.empty([SIZE] * len(done.cameras)), splits=capture.named_splits(), near=done.near, far=done.far,
        background=(0.0, 0.0, 0.0), center=done.center, radius=done.radius, up=done.up, to_input=done.to_input,
        disparity=done.disparity, ndc=done.ndc,
    )  # fmt: skip


def first(scene: Scene) -> CameraControl:
    control = CameraControl()
    control.set_scene(scene)
    return control


@cache
def opened(kind: str, points: bool) -> tuple[Arrangement, Scene, CameraControl, Camera]:
    """The arrangement, its scene, the window's camera, and that camera in the axes and metres of the world."""
    arrangement = KINDS[kind]
    scene = scene_of(arrangement, points)
    control = first(scene)
    return arrangement, scene, control, in_world(control.camera(320, 240), scene, arrangement)


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def up_of(arrangement: Arrangement, scene: Scene) -> np.ndarray:
    """The scene's up direction (3,) in the world."""
    camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.column_stack([np.eye(3), np.zeros(3)]))
    return in_world(camera, scene, arrangement).c2w[:, :3] @ scene.up


@POINTS
@EVERY
def test_the_first_view_is_upright(kind: str, points: bool) -> None:
    arrangement, scene, _, camera = opened(kind, points)
    assert degrees(up_of(arrangement, scene), UP) < 10
    seen = camera.c2w[:, :3].T @ UP
    assert abs(np.degrees(np.arctan2(seen[0], seen[1]))) < 10  # the roll of the picture


@POINTS
@EVERY
def test_the_first_view_shows_the_subject_in_its_middle(kind: str, points: bool) -> None:
    arrangement, _, _, camera = opened(kind, points)
    _, t, index = draw(arrangement.world, camera)
    if arrangement.target is None:  # from inside, over the room: no wall is before the lens, none is missing
        assert np.abs(camera.c2w[:, 3]).max() < 1.1
        assert np.isfinite(t).all()
        return
    pixels, depth = camera.project(np.array([arrangement.target]))
    assert depth[0] > 0
    assert np.abs(pixels[0] / (camera.width, camera.height) - 0.5).max() < 0.1
    if any(box.subject for box in arrangement.world):
        share = np.array([box.subject for box in arrangement.world] + [False])[index].mean()
        assert 0.1 < share < 0.7


@POINTS
@EVERY
def test_nothing_is_close_before_the_first_view(kind: str, points: bool) -> None:
    arrangement, scene, control, camera = opened(kind, points)
    _, t, _ = draw(arrangement.world, camera)
    metre = float(np.cbrt(np.linalg.det(scene.to_input[:3, :3]))) * arrangement.unit
    middle = float(np.median(t))
    assert t.min() > 0.25 * middle
    assert scene.near * metre < t.min()
    assert (scene.far * metre > middle) or scene.ndc is not None
    assert 0.1 * middle < control.distance * metre < 4 * middle  # what is orbited lies where there is something


@EVERY
def test_the_unit_of_the_input_changes_nothing(kind: str) -> None:
    for points in (True, False):
        metres = scene_of(replace(KINDS[kind], unit=1.0), points)
        for unit in (1e-3, 1e3):
            other = scene_of(replace(KINDS[kind], unit=unit), points)
            for a, b in ((metres.poses, other.poses), (metres.up, other.up), (metres.center, other.center)):
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)
            numbers = ("near", "far", "radius")
            assert [getattr(metres, n) for n in numbers] == pytest.approx(
                [getattr(other, n) for n in numbers], rel=1e-9
            )
            np.testing.assert_allclose(first(metres).c2w(), first(other).c2w(), rtol=0, atol=1e-9)
            assert first(metres).distance == pytest.approx(first(other).distance, rel=1e-9)


@POINTS
@EVERY
def test_a_second_of_flight_is_some_of_the_way_to_the_subject(kind: str, points: bool) -> None:
    arrangement, scene, _, camera = opened(kind, points)
    _, t, _ = draw(arrangement.world, camera)
    metre = float(np.cbrt(np.linalg.det(scene.to_input[:3, :3]))) * arrangement.unit
    assert 0.05 < FLY_SPEED * scene.radius * metre / float(np.median(t)) < 2


TURNED = {
    "all upside down, which EXIF says": Arrangement(OBJECT, ring(), (180,) * 24, exif=True),
    "some upside down": Arrangement(OBJECT, ring(), (0, 0, 180) * 8),
    "half upside down": Arrangement(OBJECT, ring(), (0, 180) * 12),
    "all on the left side": Arrangement(OBJECT, ring(), (270,) * 24),
    "half on a side": Arrangement(OBJECT, ring(), (0, 90) * 12),
    "every way": Arrangement(OBJECT, ring(), (0, 90, 180, 270) * 6),
    "an arc on a side, which EXIF says": Arrangement(OBJECT, ring()[:10], (270,) * 10, exif=True),
    "an arc on the other side, which EXIF says": Arrangement(OBJECT, ring()[:10], (90,) * 10, exif=True),
    "a third of an arc on a side": Arrangement(OBJECT, ring()[:12], (0, 0, 90) * 4),
    "a room with a third on a side": Arrangement(ROOM, outward(), (0, 0, 90) * 12, target=None),
    "a room, every way as EXIF says": Arrangement(ROOM, outward(), (0, 90, 180, 270) * 9, exif=True, target=None),
}  # fmt: skip


@pytest.mark.parametrize("name", TURNED)
def test_up_is_found_however_the_camera_was_held(name: str) -> None:
    scene = scene_of(TURNED[name], points=False)
    assert degrees(up_of(TURNED[name], scene), UP) < 3


def test_photos_of_a_shaking_hand_are_upright() -> None:
    """Rows of some and columns of others would span the pictures, whose normal is the direction of view."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        poses = np.zeros((20, 3, 4))
        for pose in poses:
            yaw, pitch, roll = np.radians(5) * rng.normal(size=3)
            cz, sz, cx, sx, cy, sy = (f(v) for v in (yaw, pitch, roll) for f in (np.cos, np.sin))
            turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
            pose[:, :3] = turn @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
            pose[:, 3] = rng.uniform(-0.3, 0.3, 3)
        assert degrees(up_direction(poses), np.array([0.0, 1.0, 0.0])) < 10


def test_what_nothing_tells_apart_is_left_as_the_photos_show_it() -> None:
    """A short arc of photos on their side looks like one of upright photos from above each other; and upside down like
    a scene that hangs from above."""
    arc = Arrangement(OBJECT, ring()[:6], (90,) * 6)
    assert degrees(up_of(arc, scene_of(arc)), UP) > 60
    hanging = Arrangement(OBJECT, ring(), (180,) * 24)
    assert degrees(up_of(hanging, scene_of(hanging)), -UP) < 3


def test_the_first_view_is_as_high_as_a_photo_but_not_as_one_in_portrait() -> None:
    """A wide window would else show much beside it that no photo does."""
    focal, middle = KINDS["inward"].cameras[0].fx, (SIZE[0] * SIZE[1]) ** 0.5
    for kind, side in (("inward", SIZE[1]), ("sideways", middle), ("upside down", SIZE[1])):
        camera = opened(kind, True)[3]
        assert camera.height / camera.fy == pytest.approx(side / focal)
    scene = scene_of(KINDS["inward"])
    tall = tuple(View(v.name, replace(v.camera, width=SIZE[1], height=SIZE[0])) for v in scene.views)
    camera = first(replace(scene, views=tall)).camera(320, 240)
    assert camera.height / camera.fy == pytest.approx(middle / focal)


@POINTS
def test_a_view_straight_down_has_the_photos_top_at_its_top(points: bool) -> None:
    """The direction of a photo that looks almost straight down says nothing of what is at the top."""
    arrangement, scene, _, camera = opened("aerial", points)
    assert degrees(camera.c2w[:, 2], UP) < 2
    train = scene.split("train")
    photo = arrangement.cameras[train[most_central([scene.views[i].camera for i in train], scene.center)]]
    assert degrees(camera.c2w[:, 1], photo.c2w[:, 1]) < 10
