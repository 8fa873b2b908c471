"""Camera paths: where they go, what they look at, and that they close."""

from __future__ import annotations

import inspect
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, Lens
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.paths import DEFAULT_PATH, PATHS
from nerf_core.geometry.paths.held_out import HeldOut
from nerf_core.geometry.paths.orbit import ARC, ELEVATION, Orbit
from nerf_core.geometry.paths.spiral import Spiral
from nerf_core.geometry.paths.steps import capture_distance
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.geometry.turntable import angles_from, looking_along, rotation_from


def make_scene(poses: list[np.ndarray], sizes: list[tuple[int, int]] | None = None, **changes: object) -> Scene:
    sizes = sizes or [(40, 30)] * len(poses)
    cameras = [Camera(w, h, 50.0, 50.0, w / 2, h / 2, pose) for pose, (w, h) in zip(poses, sizes, strict=True)]
    held = tuple(range(0, len(poses), 4))
    scene = Scene(
        name="made",
        format="blender",
        views=tuple(View(f"{i}.png", camera) for i, camera in enumerate(cameras)),
        photos=Photos.empty(sizes),
        splits={"train": tuple(i for i in range(len(poses)) if i not in held), "test": held},
        near=1.0,
        far=8.0,
        background=(1.0, 1.0, 1.0),
        center=np.array([0.3, -0.2, 0.5]),
        radius=1.0,
        up=np.array([0.0, 0.6, 0.8]),
        to_input=np.eye(4),
    )
    return replace(scene, **changes)  # pyright: ignore[reportArgumentType]


def around(count: int = 16, distance: float = 4.0) -> Scene:
    """Cameras on a ring about the centre, looking at it."""
    scene = make_scene([np.eye(4)[:3]])
    rotations = [rotation_from(2 * np.pi * k / count, 0.4, 0.0, scene.up) for k in range(count)]
    return make_scene([np.column_stack([r, scene.center + distance * r[:, 2]]) for r in rotations])


def forward(count: int = 20) -> Scene:
    """Cameras on a small patch of the plane z = 0 that look roughly along −z with y up, in NDC."""
    rng = np.random.default_rng(3)
    up = np.array([0.0, 1.0, 0.0])
    poses = []
    for _ in range(count):
        position = rng.uniform([-0.5, -0.2, -0.1], [0.5, 0.2, 0.1])
        direction = np.array([0.0, 0.0, -4.0]) - position
        rotation = looking_along(direction / np.linalg.norm(direction), np.eye(3), up)
        poses.append(np.column_stack([rotation, position]))
    return make_scene(poses, up=up, center=np.array([0.0, 0.0, -4.0]), ndc=Ndc(40, 30, 50.0, 1.0, 8.0))


def poses(path: tuple[Camera, ...]) -> np.ndarray:
    return np.stack([camera.c2w for camera in path])


def test_orbit_circles_the_centre() -> None:
    scene = around()
    path = Orbit.cameras(scene, 12, elevation=20, radius=2.5)
    assert len(path) == 12
    axis = scene.up / np.linalg.norm(scene.up)
    for camera in path:
        offset = camera.c2w[:, 3] - scene.center
        assert np.linalg.norm(offset) == pytest.approx(2.5)
        assert np.degrees(np.arcsin(offset @ axis / 2.5)) == pytest.approx(20)
        assert camera.project(scene.center[None])[0][0] == pytest.approx([20, 15])
        assert camera.c2w[:, 0] @ axis == pytest.approx(0, abs=1e-12)
        assert camera.c2w[:, 1] @ axis > 0


@pytest.mark.parametrize(
    "make",
    [lambda: Orbit.cameras(around(), 10), lambda: Spiral.cameras(forward(), 40), lambda: Spiral.cameras(around(), 40)],
)
def test_a_path_closes_without_repeating_a_frame(make) -> None:
    path = make()
    positions = np.stack([c.c2w[:, 3] for c in path])
    steps = np.linalg.norm(np.roll(positions, -1, axis=0) - positions, axis=1)
    assert steps.min() > 0.2 * steps.max()
    assert steps[-1] <= 1.01 * steps[:-1].max()


def test_orbit_starts_beside_the_first_training_view_at_its_distance() -> None:
    scene = around()
    path = Orbit.cameras(scene)
    first = scene.views[scene.split("train")[0]].camera
    assert len(path) == 60
    azimuth = [angles_from(c.c2w[:, :3], scene.up)[0] for c in (path[0], first)]
    assert azimuth[0] == pytest.approx(azimuth[1])
    assert np.linalg.norm(path[0].c2w[:, 3] - scene.center) == pytest.approx(4.0)
    assert (path[0].width, path[0].height, path[0].fy) == (40, 30, first.fy)


def one_sided(widest: float = 50.0) -> Scene:
    """Cameras on an arc of twice that many degrees about the centre, 10° above it, looking at it."""
    scene = around()
    rotations = [rotation_from(a, np.radians(10), 0.0, scene.up) for a in np.radians(np.linspace(-widest, widest, 17))]
    return make_scene([np.column_stack([r, scene.center + 4 * r[:, 2]]) for r in rotations])


def test_orbit_stays_before_the_side_that_photos_show() -> None:
    scene = one_sided()
    trained = np.array([angles_from(scene.views[i].camera.c2w[:, :3], scene.up) for i in scene.split("train")])
    path = np.array([angles_from(c.c2w[:, :3], scene.up) for c in Orbit.cameras(scene, 40)])
    low, high = trained[:, 0].min(), trained[:, 0].max()
    assert low - 1e-9 <= path[:, 0].min() < low + np.radians(1)
    assert high - np.radians(1) < path[:, 0].max() <= high + 1e-9
    assert path[0, 0] == pytest.approx(trained[0, 0])
    assert path[:, 1] == pytest.approx(np.radians(10))
    assert abs(path[-1, 0] - path[0, 0]) <= np.abs(np.diff(path[:, 0])).max()  # it closes


def seen_from(azimuths: list[float], elevation: float = 10.0) -> Scene:
    """Cameras at these degrees around the centre that look at it; all are trained on."""
    scene = around()
    rotations = [rotation_from(np.radians(a), np.radians(elevation), 0.0, scene.up) for a in azimuths]
    poses = [np.column_stack([r, scene.center + 4 * r[:, 2]]) for r in rotations]
    return make_scene(poses, splits={"train": tuple(range(len(poses)))})


def farthest(scene: Scene, azimuths: list[float]) -> float:
    """By how many degrees of azimuth the default orbit leaves the photos at most."""
    path = np.degrees([angles_from(c.c2w[:, :3], scene.up)[0] for c in Orbit.cameras(scene, 90)])
    apart = np.abs((path[:, None] - np.array(azimuths) + 180) % 360 - 180)
    return float(apart.min(1).max())


SIDES = {
    "front and back": ([*range(-30, 31, 5), *range(150, 211, 5)], 60.0),
    "three places": ([*range(0, 21, 5), *range(120, 146, 5), *range(240, 261, 5)], 25.0),
    "a stray photo": ([*range(-50, 51, 2), 180], 100.0),
    "across 180": ([*range(140, 180, 5), *range(-180, -140, 5)], 75.0),
    "parallel": ([0.0, 0.3, 0.9], 20.0),
    "one": ([70.0], 20.0),
    "ring of 3": ([0.0, 120.0, 240.0], 20.0),
}


@pytest.mark.parametrize(("azimuths", "arc"), SIDES.values(), ids=SIDES)
def test_orbit_shows_no_side_that_no_photo_saw(azimuths: list[float], arc: float) -> None:
    scene = seen_from(azimuths)
    assert ARC.default_in(scene) == pytest.approx(arc)
    assert farthest(scene, azimuths) <= 10.1  # half of the least arc


@pytest.mark.parametrize("azimuths", [[0, 90, 180, 270], [*range(0, 275, 5)], [*range(0, 360, 24)]])
def test_orbit_takes_a_whole_turn_where_photos_leave_no_wide_gap(azimuths: list[float]) -> None:
    scene = seen_from(azimuths)
    assert ARC.default_in(scene) == 360
    turn = [angles_from(c.c2w[:, :3], scene.up)[0] for c in Orbit.cameras(scene, 8)]
    np.testing.assert_allclose(np.diff(np.unwrap(turn)), np.pi / 4)


def test_orbit_takes_a_whole_turn_if_one_is_asked_for() -> None:
    turn = [angles_from(c.c2w[:, :3], one_sided().up)[0] for c in Orbit.cameras(one_sided(), 8, arc=360)]
    np.testing.assert_allclose(np.diff(np.unwrap(turn)), np.pi / 4)


def test_photos_along_a_wall_show_it_from_where_they_stand() -> None:
    scene, up = around(), np.array([0.0, 0.0, 1.0])
    rotation = rotation_from(0.0, 0.0, 0.0, up)
    places = [scene.center + 2.0 * rotation[:, 2] + x * rotation[:, 0] for x in np.linspace(-1.5, 1.5, 12)]
    wall = make_scene([np.column_stack([rotation, p]) for p in places], up=up, splits={"train": tuple(range(12))})
    assert ARC.default_in(wall) == pytest.approx(2 * np.degrees(np.arctan2(1.5, 2)))


def test_photos_from_above_show_all_sides() -> None:
    scene = seen_from([*range(95), 0, 4, 7, 10])
    steep = [
        replace(v, camera=seen_from([float(k)], 86.0).views[0].camera) if k < 95 else v
        for k, v in enumerate(scene.views)
    ]
    above = replace(scene, views=tuple(steep))
    assert ARC.default_in(above) == 360
    assert ELEVATION.default_in(above) == pytest.approx(86.0)


def test_cameras_in_the_middle_of_a_room_show_what_they_look_at() -> None:
    up = np.array([0.0, 0.0, 1.0])
    rotations = [rotation_from(a, 0.1, 0.0, up) for a in np.radians(np.arange(0, 100, 10))]
    room = make_scene(
        [np.column_stack([r, np.array([0.3, -0.2, 0.5]) - 0.2 * r[:, 2]]) for r in rotations], up=up,
        splits={"train": tuple(range(10))},
    )  # fmt: skip
    assert ARC.default_in(room) == pytest.approx(90)
    assert ELEVATION.default_in(room) == pytest.approx(np.degrees(0.1))


def test_a_panorama_in_the_middle_shows_all_around() -> None:
    scene = around(distance=0.0)
    lens = Lens(kind=EQUIRECTANGULAR)
    views = tuple(replace(v, camera=replace(v.camera, lens=lens)) for v in scene.views[:3])
    panoramas = replace(scene, views=views, splits={"train": (0, 1, 2)})
    assert (ARC.default_in(panoramas), ELEVATION.default_in(panoramas)) == (360, 25)


def test_distance_of_a_panorama_is_the_scenes_radius() -> None:
    scene = around(distance=0.0)
    assert capture_distance(scene) == scene.radius


def test_the_cameras_own_distance_needs_no_limits() -> None:
    scene = around(distance=3e6)
    assert np.linalg.norm(Orbit.cameras(scene, 1)[0].c2w[:, 3] - scene.center) == pytest.approx(3e6)


def test_orbit_of_an_ndc_scene_stays_before_it() -> None:
    scene = forward()
    np.testing.assert_array_equal(poses(Orbit.cameras(scene)), poses(Spiral.cameras(scene)))
    for camera in Orbit.cameras(scene, 30, elevation=80):
        assert camera.c2w[2, 3] > -0.5
        assert -camera.c2w[2, 2] < -0.9


def test_spiral_stays_within_the_cameras_and_looks_at_one_point() -> None:
    scene = forward()
    positions = np.stack([scene.views[i].camera.c2w[:, 3] for i in scene.split("train")])
    mean, spread = positions.mean(0), np.ptp(positions, axis=0)
    path = Spiral.cameras(scene)
    assert len(path) == 120
    assert all((np.abs(c.c2w[:, 3] - mean) < spread).all() for c in path)
    reach = np.abs(np.stack([c.c2w[:, 3] for c in path]) - mean).max(0)
    assert reach[0] == pytest.approx(np.percentile(np.abs(positions[:, 0] - mean[0]), 90), rel=0.1)
    # All optical axes pass through the focus: their least-squares meeting point lies on each of them.
    projectors = [np.eye(3) - np.outer(c.c2w[:, 2], c.c2w[:, 2]) for c in path]
    focus = np.linalg.solve(sum(projectors), sum(p @ c.c2w[:, 3] for p, c in zip(projectors, path, strict=True)))
    for p, camera in zip(projectors, path, strict=True):
        assert np.linalg.norm(p @ (focus - camera.c2w[:, 3])) < 1e-9
    depth = 1 / (0.25 / scene.near + 0.75 / (5 * scene.far))
    assert np.linalg.norm(focus - mean) == pytest.approx(depth)


def test_spiral_of_a_surrounding_capture_stays_by_its_first_view() -> None:
    scene = around()
    first = scene.views[scene.split("train")[0]].camera.c2w
    for camera in Spiral.cameras(scene, 20):
        assert np.linalg.norm(camera.c2w[:, 3] - first[:, 3]) < 0.3 * 4.0
        assert camera.project(scene.center[None])[0][0] == pytest.approx([20, 15])


@pytest.mark.parametrize("name", PATHS.names())
def test_every_path_is_made_of_proper_cameras(name: str) -> None:
    kind = PATHS.get(name)
    assert kind.label
    assert kind.summary
    assert kind.default_frames is None or kind.default_frames > 0
    for scene in (around(), forward()):
        for camera in kind.cameras(scene, 3, 64, 20):
            assert (camera.width, camera.height) == (64, 20)
            rotation = camera.c2w[:, :3]
            np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("name", PATHS.names())
def test_a_path_lists_all_its_options_with_their_defaults_and_limits(name: str) -> None:
    kind, scene = PATHS.get(name), around()

    def path(**options: float) -> np.ndarray:
        return poses(kind.cameras(scene, 3, None, None, **options))

    taken = list(inspect.signature(kind.cameras).parameters)
    assert taken == ["scene", "frames", "width", "height", *kind.options]
    for own, option in kind.options.items():
        default = option.default_in(scene)
        assert option.help.endswith(".")
        assert option.least <= default <= option.most
        np.testing.assert_array_equal(path(**{own: default}), path())
        for value in (option.least, option.most):
            assert np.isfinite(path(**{own: value})).all()
        for value in (math.nextafter(option.least, -math.inf), 2 * abs(option.most) + 1, math.nan):
            with pytest.raises(UserError, match=f"{own} of .*: take a number from"):
                path(**{own: value})


@pytest.mark.parametrize("name", PATHS.names())
def test_a_path_does_without_the_others(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = PATHS.get(name)
    monkeypatch.setattr(PATHS, "_items", {name: kind})
    for scene in (around(), forward()):
        assert len(kind.cameras(scene, 3)) == 3


def test_the_default_path_is_a_path() -> None:
    assert DEFAULT_PATH in PATHS.names()


def test_the_focal_length_follows_the_height() -> None:
    assert Orbit.cameras(around(), 1, 100, 60)[0].fy == pytest.approx(100)  # it is 50 for 30 rows


def test_held_out_views_keep_lens_and_pixel_shape() -> None:
    poses = [view.camera.c2w for view in around().views]
    sizes = [(30, 40) if i == 4 else (40, 30) for i in range(len(poses))]
    scene = make_scene(poses, sizes)
    views = list(scene.views)
    views[0] = replace(views[0], camera=replace(views[0].camera, lens=Lens(k1=0.1), cx=17.0))
    scene = replace(scene, views=tuple(views))
    path = HeldOut.cameras(scene)
    assert path[0] == scene.views[0].camera
    assert len(path) == len(scene.split("test"))
    assert {(c.width, c.height) for c in path} == {(40, 30)}
    assert path[1].fx == path[1].fy == pytest.approx(50 * 30 / 40)
    assert (path[1].cx, path[1].cy) == (20, 15)
    assert HeldOut.cameras(scene, 2) == path[:2]
    double = HeldOut.cameras(scene, 1, 80, 60)[0]
    assert double.intrinsics() == scene.views[0].camera.resized(80, 60).intrinsics()


def test_errors_say_what_to_do() -> None:
    scene = around()
    with pytest.raises(UserError, match="path of 0 frames is empty: take 1 or more"):
        Orbit.cameras(scene, 0)
    with pytest.raises(UserError, match="-3 pixels' width"):
        Spiral.cameras(scene, 4, -3)
    with pytest.raises(UserError, match="elevation of 91°"):
        Orbit.cameras(scene, elevation=91)
    with pytest.raises(UserError, match="elevation of nan°"):
        Orbit.cameras(scene, elevation=float("nan"))
    with pytest.raises(UserError, match="radius of -1"):
        Orbit.cameras(scene, radius=-1)
    with pytest.raises(UserError, match=r"scene made has no test views to render: take the path .*orbit or .*spiral"):
        HeldOut.cameras(replace(scene, splits={"train": scene.split("train")}))


ZIGZAG = """
from nerf_core.geometry.paths import PATHS, Option

@PATHS.register("zigzag")
class Zigzag:
    label, summary, default_frames = "Zigzag", "to and fro", 7
    options = {"swing": Option("Of a zigzag, in scene units.", 1.0, 0.0, 9.0)}

    @staticmethod
    def cameras(scene, frames=None, width=None, height=None, *, swing=None):
        return ()
"""


def test_a_kind_in_a_new_file_is_found_with_its_options(tmp_path: Path) -> None:
    (tmp_path / "zigzag.py").write_text(ZIGZAG)
    code = (
        f"import nerf_core.geometry.paths as paths; paths.__path__.append({str(tmp_path)!r}); "
        "from nerf_core.cli import main; main(['render', '--help'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    shown = " ".join(done.stdout.split())
    choices = re.search(r"--path \{([^}]*)\}", shown)
    assert choices is not None, done.stderr or shown
    assert {"orbit", "spiral", "test", "zigzag"} <= set(re.split(r", ?", choices[1]))
    for text in ("to and fro (zigzag)", "7 (zigzag)", "--swing", "Of a zigzag"):
        assert text in shown
