import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from captures import orbit_pose, write_photo
from odd_names import needs_bytes

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions, load_scene
from nerf_core.datasets.colmap_files import check_model
from nerf_core.datasets.formats import colmap
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.lens import FISHEYE, Lens
from nerf_core.geometry.scene import Scene

COUNT = 6
POSES = np.stack([orbit_pose(0.5 * i)[:3] for i in range(COUNT)])
CAMERAS = {1: "OPENCV 24 16 30 31 12.5 7.5 0.02 -0.01 0.001 0.002", 2: "SIMPLE_RADIAL 16 24 33 8 12 0.05"}
POINTS = np.random.default_rng(0).normal(0, 0.5, (20, 3))
CONVERT = """
import pycolmap, sys
model = pycolmap.Reconstruction(sys.argv[1])
for image in model.images.values():
    image.name = image.name.replace("cam_", "cam ")
model.write_binary(sys.argv[2])
"""  # pycolmap reads no spaces from text


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) by the eigenvector of Bar-Itzhack's matrix, exact at every angle."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array([[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
                  [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]])  # fmt: skip
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


def write_text(folder: Path, names: Sequence[str], cameras: dict[int, str] = CAMERAS) -> None:
    """A model in COLMAP's text format; photos take the cameras in turn, and the first three see all points."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("".join(f"{k} {v}\n" for k, v in cameras.items()))
    seen = " ".join(f"1 2 {k + 1}" for k in range(len(POINTS)))
    lines = []
    for i, name in enumerate(names):
        rotation = POSES[i, :, :3].T * np.array([[1], [-1], [-1]])
        pose = np.concatenate([quaternion(rotation), -rotation @ POSES[i, :, 3]])
        ids = list(cameras)
        lines += [f"{i + 1} {' '.join(map(str, pose))} {ids[i % len(ids)]} {name}", seen if i < 3 else ""]
    (folder / "images.txt").write_text(f"# Number of images: {len(names)}\n" + "\n".join(lines) + "\n")
    tracks = [" ".join(f"{j + 1} {k}" for j in range(min(3, len(names)))) for k in range(len(POINTS))]
    points = [f"{k + 1} {x} {y} {z} 9 9 9 0.5 {tracks[k]}" for k, (x, y, z) in enumerate(POINTS)]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")


def write_binary(folder: Path, text: Path) -> None:
    """The same model as COLMAP 4 writes it: binary, with rigs and frames."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([sys.executable, "-c", CONVERT, str(text), str(folder)], check=True)


def write_photos(folder: Path, names: Sequence[str], scale: int = 1) -> None:
    for i, name in enumerate(names):
        write_photo(folder / name, (16 // scale, 24 // scale) if i % 2 else (24 // scale, 16 // scale), seed=i)


def complaint(work: Callable[[], object]) -> str:
    """The message of a UserError, empty if none is raised; other exceptions are not caught."""
    try:
        work()
    except UserError as error:
        return str(error)
    return ""


NAMES = [f"cam {i % 2}/{i:04}.png" for i in range(COUNT)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_text(tmp_path / "sparse/0", NAMES)
    write_photos(tmp_path / "images", NAMES)
    return tmp_path


@pytest.fixture(scope="module")
def binary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("model")
    write_text(base / "text", [name.replace(" ", "_") for name in NAMES])
    write_binary(base / "binary", base / "text")
    return base / "binary"


def read(folder: Path, downscale: int = 1) -> Capture:
    return DATASETS.get("colmap").read(folder, LoadOptions(downscale=downscale))


def assert_whole(capture: Capture) -> None:
    names = [photo.name for photo in capture.photos]
    assert names == sorted(f"images/{name}" for name in NAMES)
    for photo in capture.photos:
        i = int(Path(photo.name).stem)
        np.testing.assert_allclose(photo.camera.c2w, POSES[i], atol=1e-9)
        opencv = (24, 16, 30, 31, 12.5, 7.5, 0.02, -0.01, 0, 0.001, 0.002)
        radial = (16, 24, 33, 33, 8, 12, 0.05, 0, 0, 0, 0)
        assert photo.camera.intrinsics()[:11] == (radial if i % 2 else opencv)
        assert not any(photo.camera.intrinsics()[11:])
    assert capture.points is not None
    np.testing.assert_allclose(sorted(capture.points.tolist()), sorted(POINTS.tolist()), atol=1e-12)


@pytest.mark.parametrize(
    ("camera", "lens"),
    [
        ("FULL_OPENCV 24 16 30 31 12 8 .1 .2 .3 .4 .5 .6 .7 .8", Lens(0.1, 0.2, 0.5, 0.3, 0.4, 0.6, 0.7, 0.8)),
        ("OPENCV_FISHEYE 24 16 30 31 12 8 .1 .2 .3 .4", Lens(0.1, 0.2, 0.3, k4=0.4, kind=FISHEYE)),
        ("RADIAL_FISHEYE 24 16 30 12 8 .1 .2", Lens(0.1, 0.2, kind=FISHEYE)),
        ("SIMPLE_RADIAL_FISHEYE 24 16 30 12 8 .1", Lens(0.1, kind=FISHEYE)),
    ],
)
def test_rational_and_fisheye_lenses(folder: Path, camera: str, lens: Lens) -> None:
    write_text(folder / "sparse/0", NAMES, {1: camera})
    found = read(folder).photos[0].camera
    assert (found.fx, found.cx, found.cy, found.lens) == (30, 12, 8, lens)


def test_text_models_of_several_lenses_and_orientations(folder: Path) -> None:
    assert DATASETS.get("colmap").matches(folder)
    assert not DATASETS.get("colmap").matches(folder / "images")
    capture = read(folder)
    assert_whole(capture)
    assert not capture.notes
    scene = load_scene(folder, LoadOptions(downscale=2))
    assert (scene.format, scene.up.tolist()) == ("colmap", [0, 0, 1])
    assert {image.shape for image in scene.images} == {(8, 12, 3), (12, 8, 3)}


def test_photos_know_the_reliable_points_that_they_see(folder: Path) -> None:
    """Not those that two photos see, nor those with large errors."""
    file = folder / "sparse/0/points3D.txt"
    lines = file.read_text().splitlines()
    lines[0] = lines[0].replace(" 9 9 9 0.5 ", " 9 9 9 2.5 ")
    lines[1] = lines[1].rsplit(" ", 2)[0]
    file.write_text("\n".join(lines) + "\n")
    photos = {int(Path(photo.name).stem): photo.sighted for photo in read(folder).photos}
    for i, seen in photos.items():
        if i >= 3:
            assert seen is None
        else:
            assert seen is not None
            np.testing.assert_allclose(seen, POINTS[2:], atol=1e-12)
    scene = load_scene(folder, LoadOptions())
    sighted = scene.views[0].sighted
    assert sighted is not None
    inputs = sighted @ scene.to_input[:3, :3].T + scene.to_input[:3, 3]
    np.testing.assert_allclose(inputs, POINTS[2:], atol=1e-5)


def test_binary_models_with_and_without_rigs(folder: Path, binary: Path) -> None:
    model = folder / "sparse/0"
    shutil.copytree(binary, model, dirs_exist_ok=True)
    (model / "points3D.txt").write_text("nonsense")  # text beside binary: COLMAP reads the binary
    assert (model / "rigs.bin").exists()
    assert (model / "frames.bin").exists()
    assert_whole(read(folder))
    (model / "rigs.bin").unlink()
    (model / "frames.bin").unlink()
    assert_whole(read(folder))


@needs_bytes
@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_names_of_any_bytes_are_found(folder: Path, binary: Path, suffix: str) -> None:
    odd, home = b"cam\xe9\x1b \xff", folder / os.fsdecode(b"\xe9\n")
    names = [name.replace("cam ", os.fsdecode(odd)) for name in NAMES]
    write_photos(home / "images", names)
    (home / "sparse").mkdir()
    for file in ((folder / "sparse/0") if suffix == ".txt" else binary).iterdir():
        (home / "sparse" / file.name).write_bytes(file.read_bytes().replace(b"cam ", odd))
    found = [photo.name for photo in read(home).photos]
    assert found == sorted(f"images/{name}" for name in names)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", ".", "model of mine/0"])
def test_a_model_is_found_in_several_places(folder: Path, place: str) -> None:
    wanted = folder / place
    if place == ".":
        shutil.copytree(folder / "sparse/0", wanted, dirs_exist_ok=True)
        shutil.rmtree(folder / "sparse")
    else:
        (folder / "sparse/0").rename(folder / "x")
        wanted.parent.mkdir(parents=True, exist_ok=True)
        if place == "sparse":
            shutil.rmtree(wanted)
        (folder / "x").rename(wanted)
    assert len(read(wanted if "mine" in place else folder).photos) == COUNT


def test_the_model_with_most_photos_is_taken(folder: Path) -> None:
    write_text(folder / "sparse/1", NAMES[:2])
    capture = read(folder)
    assert_whole(capture)
    assert f"{folder / 'sparse'} holds 2 models: took 0 with 6 photos (1 2)" in capture.notes


def test_photos_without_pose_and_poses_without_photo_are_counted(folder: Path) -> None:
    write_photo(folder / "images/extra.png")
    assert f"6 of the 7 photos in {folder / 'images'} are registered; the others have no pose" in read(folder).notes
    (folder / "images" / NAMES[2]).unlink()
    capture = read(folder)
    assert len(capture.photos) == COUNT - 1
    assert any("1 of 6 listed photos are missing" in note for note in capture.notes)
    shutil.rmtree(folder / "images")
    with pytest.raises(UserError, match="none of the 6 listed photos exists"):
        read(folder)


def test_reduced_folders_serve_downscale(folder: Path) -> None:
    write_photos(folder / "images_2", NAMES, 2)
    capture = read(folder, 2)
    assert capture.reduced == 2
    assert capture.photos[0].name == f"images_2/{NAMES[0]}"
    (folder / "images_2" / NAMES[0]).unlink()
    capture = read(folder, 2)
    assert (capture.reduced, capture.photos[0].name) == (1, f"images/{NAMES[0]}")
    assert f"{folder / 'images_2'} has 5 of 6 photos and is passed over" in capture.notes


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        ("FOV 24 16 30 30 12 8 0.1", "has the camera model FOV; .*image_undistorter"),
        ("PINHOLE 24 16 0 30 12 8", "'cam 0/0000.png' of 24×16 pixels has the focal lengths 0, 30"),
        ("PINHOLE 24 16 30 30 nan 8", "pycolmap cannot read|values that are not numbers"),
        ("MYSTERY 24 16 30 30 12 8", "pycolmap cannot read the model"),
    ],
)
def test_odd_cameras_are_named(folder: Path, camera: str, text: str) -> None:
    write_text(folder / "sparse/0", NAMES, {1: camera})
    with pytest.raises(UserError, match=text) as caught:
        read(folder)
    assert "\n" not in str(caught.value)
    assert str(folder / "sparse/0") in str(caught.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_binaries_cut_at_any_byte_never_reach_pycolmap(tmp_path: Path, binary: Path, name: str) -> None:
    model = tmp_path / "model"
    shutil.copytree(binary, model)
    check_model(model)
    file = model / f"{name}.bin"
    whole = file.read_bytes()
    for end in range(len(whole)):
        file.write_bytes(whole[:end])
        with pytest.raises(UserError, match=rf"{name}\.bin (breaks off|is empty|claims)"):
            check_model(model)
    file.write_bytes(whole + b"\0")
    with pytest.raises(UserError, match=rf"{name}\.bin has 1 bytes too many"):
        check_model(model)
    for place in range(0, len(whole) - 7, 4):  # a count of 2⁶⁴ − 1 wherever there may be a count
        file.write_bytes(whole[:place] + b"\xff" * 8 + whole[place + 8 :])
        assert not (said := complaint(lambda: check_model(model))) or f"{name}.bin" in said


def test_damaged_values_give_an_error_of_one_line_at_most(folder: Path, binary: Path) -> None:
    """check_model does not see this damage: pycolmap refuses it, or the numbers are checked afterwards."""
    model = folder / "sparse/0"
    shutil.copytree(binary, model, dirs_exist_ok=True)
    damages = {
        "cameras": (8, 12, 32),
        "images": (8, 72),
        "frames": (8, 12, 16, 48, 76),
        "rigs": (8, 16),
        "points3D": (51,),
    }
    for name, places in damages.items():
        file = model / f"{name}.bin"
        whole = file.read_bytes()
        for place in places:
            file.write_bytes(whole[:place] + b"\xff\xff\xff\x7f" + whole[place + 4 :])
            assert "\n" not in complaint(lambda: read(folder))
        file.write_bytes(whole)
    assert_whole(read(folder))


def test_text_that_breaks_off_is_reported(folder: Path) -> None:
    file = folder / "sparse/0/images.txt"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:7]))
    with pytest.raises(UserError, match=r"images\.txt claims '# Number of images: 6', but holds 3"):
        read(folder)
    file.write_text("".join(lines)[: len("".join(lines[:-2])) + 30])
    with pytest.raises(UserError, match="pycolmap cannot read the model"):
        read(folder)
    file.write_text("")
    with pytest.raises(UserError):
        read(folder)


def test_a_reader_that_hangs_is_stopped(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap, "READ_SECONDS", 1e-3)
    with pytest.raises(UserError, match=r"was not read within 0\.001 s, it may be damaged"):
        read(folder)


def full_size(scene: Scene, index: int) -> Camera:
    """The camera of a view of `can` over its full-size pixels, in the input's frame."""
    camera = scene.views[index].camera.resized(720, 1280)
    scale = np.cbrt(np.linalg.det(scene.to_input[:3, :3]))
    moved = scene.to_input[:3, :3] @ camera.c2w + np.outer(scene.to_input[:3, 3], (0, 0, 0, 1))
    return camera.moved(moved / (scale, scale, scale, 1))


def misses(a: Camera, b: Camera, pixels: np.ndarray) -> np.ndarray:
    """By how many pixels `b` sees the rays of `a` through `pixels` (R, 2) beside these pixels."""
    rays = camera_rays(a, 1.0, 2.0, pixels)
    seen, depth = b.project(b.c2w[:, 3] + rays.directions.numpy())
    assert (depth > 0).all()
    return np.linalg.norm(seen - pixels - 0.5, axis=1)


@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "damaged"])
def test_a_poses_json_that_is_none_says_nothing(folder: Path, kind: str) -> None:
    """It comes with the capture: a link to a device without end must not be read."""
    file = folder / "poses.json"
    if kind == "device":
        file.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    else:
        file.write_text("[" * 100_000)
    assert not colmap._of_upright_photos(folder)  # pyright: ignore[reportPrivateUsage]
    file.rmdir() if kind == "folder" else file.unlink()
    file.write_text('{"upright": true}')
    assert colmap._of_upright_photos(folder)  # pyright: ignore[reportPrivateUsage]


def test_can_as_llff_and_as_colmap(scenes: Path) -> None:
    """Poses agree to rounding, and so do rays in the centre. Towards the border they differ by the calibration.

    LLFF keeps one focal length, the first photo's, and no lens; COLMAP solved both for every photo.
    """
    llff, model = (load_scene(scenes / "can", LoadOptions(downscale=16, format=f)) for f in ("llff", "colmap"))
    assert [view.name for view in llff.views] == [view.name for view in model.views]
    assert len(model.views) == 71
    rows, columns = np.mgrid[0:1280:80, 0:720:80] + 40
    pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    border = []
    for i in range(71):
        a, b = full_size(llff, i), full_size(model, i)
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-9)
        assert misses(a, b, np.array([[360, 640]])).max() < 0.1
        assert misses(a, a.moved(b.c2w), pixels).max() < 0.01
        border.append(misses(a, b, pixels).max())
    assert model.views[0].camera.fx == pytest.approx(llff.views[0].camera.fx)
    assert 1 < np.median(border) < max(border) < 40
