"""Depth maps beside photos: the bounds that they tell, and maps that are wrong."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from exports import write_polycam, write_record3d
from PIL import Image

from nerf_core.datasets import DATASETS, Capture, LoadOptions, load_scene
from nerf_core.datasets.depths import Depths, known_depths

MAP = (12, 18)  # rows and columns; the photos have 16 and 24


def read(kind: str, folder: Path) -> Capture:
    return DATASETS.get(kind).read(folder, LoadOptions())


def ramp(near: float, far: float) -> np.ndarray:
    """Depths in metres from `near` in the left column to `far` in the right."""
    return np.tile(np.linspace(near, far, MAP[1], dtype=np.float32), (MAP[0], 1))


def write_map(file: Path, metres: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".exr":
        write_exr(file, metres)
    else:
        Image.fromarray(np.round(metres * 1000).astype(np.uint16)).save(file)


def write_exr(file: Path, metres: np.ndarray) -> None:
    """One float32 channel called R. ffmpeg writes it as Y."""
    height, width = metres.shape
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "grayf32le"]
    command += ["-s", f"{width}x{height}", "-i", "-", "-format", "float", "-f", "image2", str(file)]
    subprocess.run(command, input=metres.tobytes(), check=True)
    file.write_bytes(file.read_bytes().replace(b"chlist\0\x13\0\0\0Y\0", b"chlist\0\x13\0\0\0R\0", 1))


def capture_of(kind: str, folder: Path, maps: list[np.ndarray]) -> tuple[Capture, list[Path]]:
    """A capture with a depth map for each of its first photos."""
    if kind == "polycam":
        write_polycam(folder)
        files = [folder / f"keyframes/depth/{1000 + k}.png" for k in range(len(maps))]
    else:
        write_record3d(folder)
        files = [folder / f"depth/{k}.exr" for k in range(len(maps))]
    for file, metres in zip(files, maps, strict=True):
        write_map(file, metres)
    return read(kind, folder), files


def told(capture: Capture) -> Depths:
    depths = known_depths(capture)
    assert depths is not None
    return depths


@pytest.mark.parametrize("kind", ["polycam", "record3d"])
def test_depth_maps_tell_the_bounds(tmp_path: Path, kind: str) -> None:
    capture, _ = capture_of(kind, tmp_path, [ramp(1.0, 3.0), ramp(0.8, 4.0)])
    depths = told(capture)
    assert depths.closest == pytest.approx(0.8, abs=0.02)
    assert depths.near == pytest.approx(0.9 * depths.closest)
    assert depths.middle == pytest.approx(2.15, abs=0.15)
    assert depths.far == pytest.approx(4 / 0.9, rel=0.02)
    scene = load_scene(tmp_path, LoadOptions(format=kind))
    unit = float(np.cbrt(np.linalg.det(scene.to_input[:3, :3])))  # metres per unit of the scene
    assert scene.near * unit == pytest.approx(depths.near, rel=1e-6)
    assert not any("depth map" in note for note in (*capture.notes, *scene.notes))


def test_pixels_without_a_depth_do_not_count(tmp_path: Path) -> None:
    holes = ramp(1.0, 3.0)
    holes[::2] = 0
    assert told(capture_of("polycam", tmp_path / "p", [holes])[0]).closest == pytest.approx(1, abs=0.02)
    holes[::2] = np.nan
    holes[1] = np.inf
    holes[3] = -1
    assert told(capture_of("record3d", tmp_path / "r", [holes])[0]).closest == pytest.approx(1, abs=0.02)


def test_uncertain_pixels_tell_only_how_far_content_may_reach(tmp_path: Path) -> None:
    metres = ramp(1.0, 3.0)
    metres[:, :2], metres[:, -3:] = 0.2, 9.0  # a false near surface, and a background that LiDAR cannot see
    confidence = np.full(MAP, 255, np.uint8)
    confidence[:, :2] = confidence[:, -3:] = 0
    confidence[:, 2:5] = 127  # medium counts
    capture, (file,) = capture_of("polycam", tmp_path, [metres])
    assert told(capture).closest == pytest.approx(0.2, abs=0.01)
    beside = tmp_path / "keyframes/confidence" / file.name
    beside.parent.mkdir()
    Image.fromarray(confidence).save(beside)
    depths = told(read("polycam", tmp_path))
    assert depths.closest == pytest.approx(metres[0, 2], abs=0.02)
    assert depths.far == pytest.approx(10, rel=0.01)
    Image.fromarray(confidence[:, :-1]).save(beside)
    capture = read("polycam", tmp_path)
    assert capture.depths is None
    assert any("1 depth map of 1 that were tried is not used" in n and "another size" in n for n in capture.notes)


WRONG = {
    "another shape": ramp(1, 3)[:, :9],
    "holds no depths": np.zeros(MAP, np.float32),
    "holds no depths: all are 0 or no numbers": np.full(MAP, np.nan, np.float32),
}


@pytest.mark.parametrize("kind", ["polycam", "record3d"])
@pytest.mark.parametrize("fault", [*WRONG, "text", "cut off", "colours"])
def test_a_wrong_map_is_left_out_and_said_in_one_line(tmp_path: Path, kind: str, fault: str) -> None:
    _, (file, _) = capture_of(kind, tmp_path, [ramp(0.01, 0.02), ramp(1.0, 3.0)])
    if fault in WRONG:
        write_map(file, np.nan_to_num(WRONG[fault]) if kind == "polycam" else WRONG[fault])
    elif fault == "text":
        file.write_text("no image\n" * 20)
    elif fault == "cut off":
        file.write_bytes(file.read_bytes()[:60])
    elif kind == "polycam":
        Image.new("RGB", (MAP[1], MAP[0]), (9, 9, 9)).save(file)
    else:
        data = file.read_bytes()
        file.write_bytes(data.replace(b"chlist\0\x13\0\0\0R\0", b"chlist\0\x13\0\0\0RG", 1))
    capture = read(kind, tmp_path)
    assert told(capture).closest == pytest.approx(1, abs=0.02)
    (note,) = [n for n in capture.notes if "depth map" in n]
    assert "\n" not in note
    assert note.startswith("1 depth map of 2 that were tried is not used: ")
    assert file.name in note or fault == "cut off"
    assert fault not in WRONG or fault in note


def test_a_capture_whose_maps_are_all_wrong_has_no_depths(tmp_path: Path) -> None:
    capture, _ = capture_of("polycam", tmp_path, [np.zeros(MAP, np.float32)] * 2)
    assert capture.depths is None
    assert known_depths(capture) is None
    assert any("2 depth maps of 2" in note for note in capture.notes)


@pytest.mark.parametrize("mode", ["L", "P"])
def test_a_picture_that_holds_no_millimetres_is_told(tmp_path: Path, mode: str) -> None:
    _, files = capture_of("polycam", tmp_path, [ramp(1.0, 3.0)])
    Image.fromarray((40 * ramp(1.0, 3.0)).astype(np.uint8)).convert(mode).save(files[0])
    notes = read("polycam", tmp_path).notes
    assert any(f"not a grey picture of 16 bits (Pillow's mode {mode})" in note for note in notes)


def test_the_largest_value_is_no_depth(tmp_path: Path) -> None:
    metres = ramp(1.0, 3.0)
    metres[:, -3:] = 65.535
    depths = told(capture_of("polycam", tmp_path, [metres])[0])
    assert depths.far < 3.5
