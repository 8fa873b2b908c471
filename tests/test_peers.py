"""tests/benchmarks/peers gives every program the same cameras and photos, and says what it cannot run."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from peers import compare, photos
from peers.adapters import opensplat

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.scene import Scene

DEMO = Path(__file__).parents[1] / "assets" / "demo"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    photos.prepare(DEMO, "auto", 2, folder)
    return folder


@pytest.mark.parametrize("format_name", ["blender", "transforms"])
def test_what_is_written_is_the_capture(prepared: Path, format_name: str) -> None:
    original = load_scene(DEMO, LoadOptions(downscale=2))
    written = load_scene(prepared, LoadOptions(format=format_name))
    assert written.held_out()[0] == "test"
    for name in ("near", "far"):
        lengths = (getattr(s, name) * np.linalg.norm(s.to_input[:3, 0]) for s in (original, written))
        assert len({round(float(length), 9) for length in lengths}) == 1
    for split in ("train", "test"):
        assert len(written.split(split)) == len(original.split(split)) > 0
        for i, k in zip(written.split(split), original.split(split), strict=True):
            mine, theirs = written.views[i].camera, original.views[k].camera
            assert np.allclose(mine.intrinsics(), theirs.intrinsics(), atol=1e-6)
            points = in_input(original, np.random.default_rng(0).uniform(-1, 1, (20, 3)))
            for a, b in zip(seen(written, i, points), seen(original, k, points), strict=True):
                assert np.allclose(a, b, atol=1e-4)  # pixels, z-depths in the input's units
            difference = written.images[i].astype(float) - original.images[k]
            assert np.abs(difference).max() <= 0.51 * 257  # 8 bits, rounded once


def in_input(scene: Scene, points: np.ndarray) -> np.ndarray:
    return points @ scene.to_input[:3, :3].T + scene.to_input[:3, 3]


def seen(scene: Scene, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a view shows points that are given in the input's frame: pixels and z-depths."""
    local = (points - scene.to_input[:3, 3]) @ np.linalg.inv(scene.to_input[:3, :3]).T
    pixels, depth = scene.views[view].camera.project(local)
    return pixels, depth * np.linalg.norm(scene.to_input[:3, 0])


def test_only_training_photos_reach_a_program_without_splits(prepared: Path) -> None:
    whole = json.loads((prepared / "transforms.json").read_text())
    train = json.loads((prepared / "train" / "transforms.json").read_text())
    names = [frame["file_path"] for frame in train["frames"]]
    assert [name.removeprefix("../") for name in names] == whole["train_filenames"]
    assert not set(whole["train_filenames"]) & set(whole["test_filenames"])
    assert all((prepared / "train" / name).is_file() for name in [*names, train["ply_file_path"]])


def test_a_lens_and_a_shifted_centre_are_undone() -> None:
    camera = Camera(160, 120, 100, 110, 75, 66, np.eye(4)[:3], Lens(k1=-0.2, k2=0.05, p1=0.01))
    rows, columns = np.mgrid[:120, :160] + 0.5
    ideal = camera.lens.undistort(np.stack([(columns - 75) / 100, (rows - 66) / 110], -1))
    small, image = photos.pinhole(camera, picture(ideal), 2)
    assert (small.width, small.height, small.cx, small.cy, small.lens.bends) == (80, 60, 40, 30, False)
    rows, columns = np.mgrid[:60, :80] + 0.5
    plane = np.stack([(columns - 40) / small.fx, (rows - 30) / small.fy], -1)
    assert np.abs(image.astype(float) - picture(plane) / 257).max() < 1.5


def picture(plane: np.ndarray) -> np.ndarray:
    """A smooth picture, uint16 (H, W, 3), of the directions (H, W, 2)."""
    x, y = np.moveaxis(plane, -1, 0)
    channels = np.stack([np.sin(3 * x), np.cos(2 * y), np.sin(2 * x + y)], -1)
    return ((channels + 1) / 2 * 65535).round().astype(np.uint16)


def test_points_have_the_colours_of_the_photos(tmp_path: Path) -> None:
    scene = load_scene(DEMO, LoadOptions())
    points = in_input(scene, np.array([[50.0, 0, 0], *np.zeros((1, 3))]))
    found = photos.colours(scene, points)
    assert found.shape == (2, 3)
    photos.write_points(tmp_path / "points.ply", points, found)
    body = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")[1]
    assert len(body) == 2 * 15
    assert tuple(body[12:15]) == tuple(found[0])


def test_a_missing_program_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare.py", str(DEMO), "--peers", "opensplat", "--opensplat", str(tmp_path / "none"), "--times", "1"]
    monkeypatch.setattr(sys, "argv", [*words, "--downscale", "4", "--out", str(tmp_path)])
    compare.main()
    assert "| OpenSplat | not measured: build it" in capsys.readouterr().out
    stored = json.loads((tmp_path / "peers.json").read_text())
    assert stored["peers"]["opensplat"]["runs"] == []
    assert (tmp_path / "peers.png").is_file()
    assert compare.earlier(tmp_path / "peers.json", stored["photos"], True) == stored["peers"]
    with pytest.raises(SystemExit, match="give another --out"):
        compare.earlier(tmp_path / "peers.json", "other photos", True)


def test_every_adapter_has_the_members_of_one() -> None:
    found = compare.adapters()
    assert set(found) == {"ours", "opensplat", "mitsuba", "nerfacto"}
    for peer in found.values():
        assert peer.FIRST > 0
        assert all(callable(getattr(peer, name)) for name in ("missing", "command", "render"))


def test_the_next_amount_follows_the_runs_before() -> None:
    assert compare.next_amount([], 5, 60) == 5
    assert compare.next_amount([(10, 20.0)], 5, 60) == 30
    assert compare.next_amount([(10, 12.0), (20, 22.0)], 5, 62) == pytest.approx(60)  # 2 s to start, 1 s each
    assert compare.next_amount([(10, 50.0), (20, 22.0)], 5, 44) == 40  # the first run compiled


def test_cpu_seconds_are_those_of_the_child(tmp_path: Path) -> None:
    code = "import time\nwhile time.process_time() < 0.4: pass\ntime.sleep(0.4)"
    found = compare.timed([sys.executable, "-c", code], tmp_path / "log", 60)
    assert 0.4 <= found["cpu"] < found["wall"]
    assert found["wall"] >= 0.8
    with pytest.raises(compare.PeerError, match="exit status 3: no such scene"):
        compare.timed([sys.executable, "-c", "print('no such scene'); raise SystemExit(3)"], tmp_path / "log", 60)
    with pytest.raises(compare.PeerError, match=r"ended after 0\.5 s"):
        compare.timed([sys.executable, "-c", "import time; time.sleep(30)"], tmp_path / "log", 0.5)


def test_splats_are_drawn_where_they_lie_and_the_nearer_in_front() -> None:
    """Two round splats on one ray, red in front of blue, seen from a camera that is turned and moved."""
    angle = 0.3
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    pose = np.block([[turn, np.array([[1.0], [2], [3]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    frame = {"w": 40, "h": 30, "fl_x": 50, "fl_y": 50, "transform_matrix": pose.tolist()}
    sideways = np.array([0.11, 0.05])  # right and up, at depth 1
    means = np.array([[*(sideways * d), -d] for d in (2.0, 4.0)]) @ turn.T + pose[:3, 3]
    blue, red = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    colours = (np.array([red, blue]) - 0.5) / opensplat.Y0
    splats = {axis: means[:, k] for k, axis in enumerate("xyz")} | {f"f_dc_{c}": colours[:, c] for c in range(3)}
    splats |= {f"f_rest_{k}": np.zeros(2) for k in range(45)} | {"opacity": np.zeros(2)}  # a sigmoid: one half
    splats |= {f"scale_{k}": np.log([0.1, 0.2]) for k in range(3)}
    splats |= {f"rot_{k}": np.full(2, float(k == 0)) for k in range(4)}
    image = opensplat.draw(splats, frame, opensplat.depth_order)
    x, y = np.array([20.0, 15]) + 50 * sideways * (1, -1)
    assert np.unravel_index((image[..., 0] - image[..., 1]).argmax(), (30, 40)) == (int(y), int(x))
    at = np.array([int(x), int(y)]) + 0.5 - (x, y)
    share = 0.5 * math.exp(-0.5 * (at**2).sum() / ((50 * 0.1 / 2) ** 2 + opensplat.BLUR))
    left = (1 - share) ** 2
    expected = share * np.array(red) + share * (1 - share) * np.array(blue) + left * np.array(opensplat.BACKGROUND)
    assert image[int(y), int(x)] == pytest.approx(expected, abs=0.01)


def test_the_released_order_reads_on_from_the_first_depth() -> None:
    """Version 1.1.5 takes x, y, z of the first point, then of the second …, from the first z on."""
    view = np.array([[0.1, 0.2, 1.0], [0.3, 0.4, 2.0], [0.5, 0.6, 4.0]])
    frame = {"w": 2, "h": 4, "fl_x": 1, "fl_y": 2}
    key = opensplat.released_order(view, frame)
    assert key == pytest.approx([(1000.001 - 1) / 999.999, 0.3 / 2, 0.4 / 2], abs=1e-6)


def test_our_command_trains_and_its_pictures_are_measured(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = compare.adapters()["ours"]
    monkeypatch.setattr(compare, "ATTEMPTS", 1)
    monkeypatch.setattr(ours, "FIRST", 5)
    run = compare.measure(ours, prepared, tmp_path, 1e-3, [], "voxels")
    whole = json.loads((prepared / "transforms.json").read_text())
    assert len(run["each"]) == len(whole["test_filenames"])
    assert 5 < run["psnr"] < 40
    assert run["psnr"] == pytest.approx(sum(run["each"]) / len(run["each"]))
