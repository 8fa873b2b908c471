from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf_core.common.errors import UserError
from nerf_core.datasets import Capture, LoadOptions, Photo, load_scene
from nerf_core.datasets.depths import known_depths
from nerf_core.datasets.geometry import Normalised, normalise
from nerf_core.datasets.rig import common_focus, up_direction, upright
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.forward_facing import mean_camera
from nerf_core.geometry.lens import Lens

AUTO, ON = LoadOptions(), LoadOptions(ndc="on")


def looking(position: Any, target: Any, up: Any = (0, 0, 1)) -> np.ndarray:
    back = np.subtract(position, target).astype(np.float64)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])


def capture(poses: Any, focal: float = 20.0, **known: Any) -> Capture:
    cameras = [Camera(24, 16, focal, focal, 12, 8, np.asarray(pose)) for pose in poses]
    return Capture("test", tuple(Photo(f"{i}.png", Path(f"{i}.png"), c) for i, c in enumerate(cameras)), **known)


def ring(count: int = 12, height: float = 2.0, focus: Any = (1.0, 2.0, 3.0)) -> list[np.ndarray]:
    """Cameras on a circle of radius 4 around the vertical through `focus`, `height` above it, looking at it."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [looking(np.add(focus, [4 * np.cos(a), 4 * np.sin(a), height]), focus) for a in angles]


def wall(count: int = 9) -> list[np.ndarray]:
    """Cameras side by side in the plane y = 0, looking along +y, +z up."""
    places = [(0.3 * (i % 3 - 1), 0.0, 0.3 * (i // 3 - 1)) for i in range(count)]
    return [looking(place, np.add(place, (0, 1, 0))) for place in places]


def centers(done: Normalised) -> np.ndarray:
    return np.stack([camera.c2w[:, 3] for camera in done.cameras])


def assert_sound(done: Normalised, given_: Capture) -> None:
    """`to_input` is a similarity that restores positions and axes, and the lengths are usable for training."""
    linear, offset = done.to_input[:3, :3], done.to_input[:3, 3]
    size = np.cbrt(np.linalg.det(linear))
    np.testing.assert_allclose(linear @ linear.T, size**2 * np.eye(3), rtol=0, atol=1e-9 * size**2)
    before = np.stack([photo.camera.c2w for photo in given_.photos])
    after = np.stack([camera.c2w for camera in done.cameras])
    scale = np.abs(before[:, :, 3]).max() + size
    np.testing.assert_allclose(after[:, :, 3] @ linear.T + offset, before[:, :, 3], rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(linear @ after[:, :, :3] / size, before[:, :, :3], rtol=0, atol=1e-9)
    assert 0 < done.near < done.far < np.inf
    assert 0 < done.radius < np.inf
    assert np.isfinite(done.center).all()
    assert np.linalg.norm(done.up) == pytest.approx(1)


def test_a_ring_gets_its_focus_as_origin_its_distance_as_unit_and_its_axis_as_up() -> None:
    tilted = upright(np.array([0.6, 0.0, 0.8])).T  # the world's up is (0.6, 0, 0.8)
    poses = [tilted @ pose for pose in ring()]
    points = (tilted @ (np.random.default_rng(0).normal((1, 2, 3), 0.3, (500, 3))).T).T
    given_ = capture(poses, points=points)
    done = normalise(given_, AUTO)
    assert_sound(done, given_)
    np.testing.assert_allclose(centers(done)[:, 2], 2 / np.sqrt(20), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(centers(done), axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(done.to_input[:3, 3], tilted @ [1, 2, 3], atol=1e-9)
    assert (done.up.tolist(), done.center.tolist(), done.radius) == ([0, 0, 1], [0, 0, 0], pytest.approx(1))
    assert (done.disparity, done.ndc, done.notes) == (True, None, ())
    assert 0.6 < done.near < 0.9
    assert 1.1 < done.far < 1.4


def test_the_focus_ignores_cameras_that_look_elsewhere() -> None:
    poses = ring(20)
    poses[3], poses[11] = looking((5, 2, 5), (9, 9, 9)), looking((1, 6, 5), (40, -3, 9))
    focus = common_focus(np.stack(poses))
    assert focus is not None
    np.testing.assert_allclose(focus, (1, 2, 3), atol=0.05)
    assert common_focus(np.stack(wall())) is None
    assert common_focus(np.stack(ring(1))) is None
    outwards = [np.column_stack([-p[:, 0], p[:, 1], -p[:, 2], p[:, 3]]) for p in ring(height=0)]
    assert common_focus(np.stack(outwards)) is None
    on_the_spot = [np.column_stack([p[:, :3], (7e5, 0, 0)]) for p in ring()]
    assert common_focus(np.stack(on_the_spot)) is None


def test_up_is_level_although_cameras_look_down_on_one_side() -> None:
    quarter = np.stack(ring(24, height=3.0)[:7])
    assert np.degrees(np.arccos(up_direction(quarter)[2])) < 1e-3
    top = quarter[:, :, 1].mean(0)
    assert np.degrees(np.arccos(top[2] / np.linalg.norm(top))) > 10  # the mean of the cameras' up axes alone is 10° off
    np.testing.assert_allclose(up_direction(np.stack(wall())), (0, 0, 1), atol=1e-12)
    rolled = np.stack(ring(8))
    rolled[::2] = rolled[::2][:, :, [1, 0, 2, 3]] * (1, -1, 1, 1)  # photos of a turned camera: rows are vertical
    assert np.isfinite(up_direction(rolled)).all()


@given(st.integers(0, 2**32 - 1))
def test_upright_is_the_smallest_rotation_to_z(seed: int) -> None:
    up = np.random.default_rng(seed).normal(size=3)
    for v in (up / np.linalg.norm(up), np.array([0, 0, -1.0]), np.array([0, 0, 1.0])):
        rotation = upright(v)
        np.testing.assert_allclose(rotation @ v, (0, 0, 1), atol=1e-7)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-7)
        assert np.linalg.det(rotation) > 0
        assert np.trace(rotation) == pytest.approx(1 + 2 * v[2], abs=1e-7)  # 1 + 2 cos of the angle between


def test_forward_facing_captures_take_ndc_in_the_official_frame() -> None:
    given_ = capture(wall(), bounds_per_photo=np.tile([6.0, 30.0], (9, 1)), ndc_capable=True)
    done = normalise(given_, AUTO)
    assert_sound(done, given_)
    assert done.ndc is not None
    scale = 1 / (0.75 * 6)
    assert (done.ndc.near, done.ndc.far) == (1, pytest.approx(30 * scale))
    assert (done.ndc.width, done.ndc.height, done.ndc.focal) == (24, 16, 20)
    assert (done.near, done.far, done.disparity) == (pytest.approx(0.9 * 6 * scale), pytest.approx(30 * scale), False)
    mean = mean_camera(np.stack([camera.c2w for camera in done.cameras]))
    assert mean is not None
    np.testing.assert_allclose(mean, np.eye(4)[:3], atol=1e-12)
    ahead = done.to_input @ [0, 0, -1 / 0.75, 1]
    np.testing.assert_allclose(ahead, [0, 6, 0, 1], atol=1e-9)  # the nearest bound
    assert (done.up.tolist(), done.center[2]) == ([0, 1, 0], pytest.approx(-done.radius))
    assert done.near < done.radius < done.far
    assert normalise(given_, LoadOptions(ndc="off")).ndc is None
    assert normalise(replace(given_, ndc_capable=False), AUTO).ndc is None
    assert normalise(replace(given_, ndc_capable=False), ON).ndc is not None


def test_the_mean_camera_is_the_official_one() -> None:
    poses = np.stack([looking((x, 0.2 * x, 1), (0, 5, x), (0.1, 0, 1)) for x in np.linspace(-1, 1, 7)])
    back = poses[:, :, 2].sum(0)
    z = back / np.linalg.norm(back)
    x = np.cross(poses[:, :, 1].sum(0), z)
    x /= np.linalg.norm(x)
    expected = np.stack([x, np.cross(z, x), z, poses[:, :, 3].mean(0)], 1)  # poses_avg, viewmatrix of load_llff.py
    mean = mean_camera(poses)
    assert mean is not None
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    assert mean_camera(np.stack([looking((0, 1, 0), (0, 0, 0)), looking((0, -1, 0), (0, 0, 0))])) is None


def test_ndc_is_refused_where_a_ray_turns_away() -> None:
    # its axis points forward, but one side of its frame does not
    turned = looking((0, 0, 0), (np.sin(1.3), np.cos(1.3), 0))
    bounds = np.tile([2.0, 9.0], (10, 1))
    given_ = capture([*wall(), turned], bounds_per_photo=bounds, ndc_capable=True)
    text = "1 of 10 cameras have rays that do not point along the mean view"
    with pytest.raises(UserError, match=f"--ndc on is impossible: {text}; take --ndc auto or off"):
        normalise(given_, ON)
    done = normalise(given_, AUTO)
    assert_sound(done, given_)
    assert done.ndc is None
    assert done.disparity
    assert f"NDC is not taken: {text}" in done.notes
    narrow = capture([*wall(), turned], focal=80, bounds_per_photo=bounds, ndc_capable=True)
    assert normalise(narrow, AUTO).ndc is not None
    with pytest.raises(UserError, match="neither depth bounds nor sparse points"):
        normalise(capture(wall()), ON)
    with pytest.raises(UserError, match="no mean direction of view"):
        normalise(capture(ring(height=0), near=1.0, far=9.0), ON)


def test_ndc_is_not_taken_if_the_lens_widens_the_view_too_far() -> None:
    turned = looking((0, 0, 0), (np.sin(1.1), np.cos(1.1), 0))
    given_ = capture([*wall(), turned], near=2.0, far=9.0, ndc_capable=True)
    assert normalise(given_, AUTO).ndc is not None
    barrel = tuple(replace(photo, camera=replace(photo.camera, lens=Lens(k1=-0.3))) for photo in given_.photos)
    assert normalise(replace(given_, photos=barrel), AUTO).ndc is None


def test_bounds_come_from_what_is_known() -> None:
    bounds = np.array([[2.0, 9.0], [1.0, 30.0]])
    known = known_depths(capture(wall(2), bounds_per_photo=bounds))
    assert known is not None
    assert (known.closest, known.near, known.far) == (1, 0.9, 30)
    known = known_depths(capture(wall(2), near=0.5, far=4.0, bounds_per_photo=bounds))
    assert known is not None
    assert (known.closest, known.near, known.far) == (0.5, 0.5, 4)
    assert known_depths(capture(wall(2))) is None
    behind = np.array([[0.0, -5.0, 0.0]])
    assert known_depths(capture(wall(2), points=behind)) is None
    random = np.random.default_rng(0)
    points = np.stack([random.uniform(-0.5, 0.5, 4000), random.uniform(5, 10, 4000), np.zeros(4000)], 1)
    outliers = np.array([[0, 0.001, 0], [0, 5e6, 0], [0, -3, 0]])
    known = known_depths(capture(wall(), points=np.concatenate([points, outliers])))
    assert known is not None
    assert 0.9 * 5 < known.near < 5
    assert known.middle == pytest.approx(7.5, rel=0.02)
    assert 10 < known.far < 11.2


def test_one_percent_of_the_points_counts_and_a_tenth_of_a_percent_does_not() -> None:
    """The bounds are the percentiles 0.5 and 99.5: 1 % of the points is content, 0.1 % is outliers."""
    depth = np.concatenate([np.full(1000, 6.0), np.full(10, 3.0), np.full(10, 20.0), [1.0], [200.0]])
    points = np.stack([np.zeros_like(depth), depth, np.zeros_like(depth)], 1)
    known = known_depths(capture(wall(1), points=points))
    assert known is not None
    assert (known.closest, known.middle) == (3, 6)
    assert known.far == pytest.approx(20 / 0.9)


def test_a_far_background_is_bounded() -> None:
    given_ = capture(ring(), near=1.0, far=1000.0)
    done = normalise(given_, AUTO)
    assert_sound(done, given_)
    size = float(np.sqrt(20))
    assert 1 / np.cbrt(np.linalg.det(done.to_input[:3, :3])) == pytest.approx(0.5 / size)
    assert done.far == pytest.approx(0.5 + np.pi)
    assert "content farther than 32.57 of the input's units (up to 1000) is drawn there" in done.notes
    near_by = normalise(capture(ring(), near=1.0, far=15.0), AUTO)
    assert near_by.far == pytest.approx(15 / size)
    assert not near_by.notes


def test_without_depths_the_bounds_come_from_the_focus() -> None:
    done = normalise(capture(ring()), AUTO)
    assert (done.near, done.far) == (pytest.approx(0.25), pytest.approx(1 + np.pi))
    assert not done.notes
    done = normalise(capture(wall()), AUTO)
    assert any("no depths are known" in note for note in done.notes)


def test_photos_from_one_place_are_noted() -> None:
    done = normalise(capture([np.column_stack([p[:, :3], (5, 5, 5)]) for p in ring()]), AUTO)
    assert "all photos were taken from one place: they tell directions, but no depth" in done.notes
    assert not centers(done).any()


def test_synthetic_captures_keep_their_frame() -> None:
    given_ = capture(ring(focus=(0, 0, 0.4)), synthetic=True, near=3.0, far=5.0, up=np.array([0, 0, 1.0]))
    done = normalise(given_, AUTO)
    assert (done.near, done.far, done.disparity, done.ndc) == (3, 5, False, None)
    assert np.array_equal(done.to_input, np.eye(4))
    np.testing.assert_allclose(done.center, (0, 0, 0.4), atol=1e-9)
    assert done.radius == pytest.approx(np.sqrt(20))
    plain = normalise(capture(wall(), synthetic=True), AUTO)
    assert (plain.near, plain.far, plain.center.tolist()) == (2, 6, [0, 0, 0])


def test_lengths_beyond_floats_are_refused() -> None:
    with pytest.raises(UserError, match="lengths span too many magnitudes"):
        normalise(capture(ring(), near=1e-300, far=1.0), AUTO)


@st.composite
def rigs(draw: st.DrawFn) -> Capture:
    """One to nine cameras: anywhere, parallel, in a line, on a ring or on one spot; with or without known depths."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 9))
    poses = np.stack(
        [looking(random.normal(size=3), random.normal(size=3), random.normal(size=3)) for _ in range(count)]
    )
    kind = draw(st.sampled_from(["free", "spot", "parallel", "ring", "line"]))
    if kind == "ring":
        poses = np.stack(ring(count, float(random.normal())))
    if kind == "spot":
        poses[:, :, 3] = random.normal(size=3)
    if kind in ("parallel", "line"):
        poses[:, :, :3] = poses[0, :, :3]
    if kind == "line":
        poses[:, :, 3] = np.linspace(0, 1, count)[:, None] * poses[0, :, 2]
    size = 10.0 ** draw(st.integers(-4, 5))
    poses[:, :, 3] = (poses[:, :, 3] + draw(st.sampled_from([0.0, 100.0]))) * size
    known = draw(st.sampled_from(["nothing", "bounds", "points", "near"]))
    nears = size * random.uniform(0.01, 5, (count, 1))
    extra: dict[str, Any] = {
        "nothing": {},
        "bounds": {"bounds_per_photo": np.concatenate([nears, nears * random.uniform(1.01, 1000)], 1)},
        "points": {"points": poses[0, :, 3] + size * random.normal(size=(50, 3))},
        "near": {"near": float(nears[0, 0]), "far": float(nears[0, 0] * random.uniform(1.01, 1e4))},
    }[known]
    return capture(poses, ndc_capable=draw(st.booleans()), **extra)


@settings(max_examples=200, deadline=None)
@given(rigs(), st.sampled_from(["auto", "on", "off"]))
def test_any_rig_gets_a_sound_frame(given_: Capture, ndc: Any) -> None:
    try:
        done = normalise(given_, LoadOptions(ndc=ndc))
    except UserError:
        if ndc != "on":
            raise
        return
    assert_sound(done, given_)
    if ndc == "off":
        assert done.ndc is None
    if done.ndc is None:
        assert np.sqrt((centers(done) ** 2).sum(1).mean()) < 3
        assert np.linalg.norm(centers(done), axis=1).min() < 10


def test_fern_is_forward_facing_and_the_can_is_not(scenes: Path) -> None:
    fern = load_scene(scenes / "fern", LoadOptions(downscale=8))
    assert len(fern.views) == 20
    assert fern.ndc is not None
    can = load_scene(scenes / "can", LoadOptions(downscale=16, format="llff"))
    assert len(can.views) == 71
    assert (can.ndc, can.disparity) == (None, True)
    assert any(note.startswith("NDC is not taken") for note in can.notes)
    with pytest.raises(UserError, match=r"--ndc on is impossible: \d+ of 71 cameras"):
        load_scene(scenes / "can", LoadOptions(downscale=16, format="llff", ndc="on"))
