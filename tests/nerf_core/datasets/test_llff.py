import io
from pathlib import Path

import numpy as np
import pytest
from captures import orbit_pose, write_photo
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from odd_names import ODD, SHOWN, needs_bytes

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions, load_scene
from nerf_core.datasets.formats.llff import read_table

COUNT = 5
POSES = np.stack([orbit_pose(0.3 * i)[:3] for i in range(COUNT)])


def table(poses: np.ndarray = POSES) -> np.ndarray:
    """A table as LLFF stores it: axes [down, right, back], photos of 48×32, focal length 60, bounds 2 and 8."""
    stored = np.stack([-poses[:, :, 1], poses[:, :, 0], poses[:, :, 2], poses[:, :, 3]], 2)
    hwf = np.broadcast_to([[32.0], [48.0], [60.0]], (len(poses), 3, 1))
    return np.concatenate(
        [np.concatenate([stored, hwf], 2).reshape(len(poses), 15), np.tile([2.0, 8.0], (len(poses), 1))], 1
    )


def write(folder: Path, array: np.ndarray) -> None:
    np.save(folder / "poses_bounds.npy", array)


def photos(folder: Path, size: tuple[int, int], count: int = COUNT) -> None:
    for i in range(count):
        write_photo(folder / f"image{i:03}.png", size, seed=i)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, table())
    photos(tmp_path / "images", (48, 32))
    return tmp_path


def read(folder: Path, downscale: int = 1) -> Capture:
    return DATASETS.get("llff").read(folder, LoadOptions(downscale=downscale))


def test_axes_and_intrinsics_are_turned_to_ours(folder: Path) -> None:
    capture = read(folder)
    assert [photo.name for photo in capture.photos] == [f"images/image{i:03}.png" for i in range(COUNT)]
    for photo, pose in zip(capture.photos, POSES, strict=True):
        np.testing.assert_allclose(photo.camera.c2w, pose, atol=1e-12)
    assert capture.photos[0].camera.intrinsics() == (48, 32, 60, 60, 24, 16, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    assert capture.bounds_per_photo is not None
    assert capture.bounds_per_photo.tolist() == [[2, 8]] * COUNT
    assert (capture.ndc_capable, capture.notes) == (True, ())
    assert DATASETS.get("llff").matches(folder)
    assert not DATASETS.get("llff").matches(folder / "images")


@needs_bytes
def test_names_of_any_bytes_are_read(folder: Path) -> None:
    home = folder / ODD
    (home / "images").mkdir(parents=True)
    (folder / "poses_bounds.npy").rename(home / "poses_bounds.npy")
    for i, photo in enumerate(sorted((folder / "images").iterdir())):
        photo.rename(home / "images" / f"{i}{ODD}.png")
    assert [view.name for view in load_scene(home, LoadOptions()).views] == [
        f"images/{i}{SHOWN}.png" for i in range(COUNT)
    ]


def sizes(folder: Path, downscale: int) -> tuple[str, tuple[int, ...], float]:
    """The folder of the first view's photo, its loaded height and width, and its camera's width."""
    view = (scene := load_scene(folder, LoadOptions(format="llff", downscale=downscale))).views[0]
    assert view.camera.fx / view.camera.width == pytest.approx(60 / 48)
    return view.name.split("/")[0], scene.images[0].shape[:2], view.camera.width


def test_downscale_counts_from_full_size_whatever_folder_is_taken(folder: Path) -> None:
    assert sizes(folder, 4) == ("images", (8, 12), 12)
    photos(folder / "images_4", (12, 8))
    assert sizes(folder, 1) == ("images", (32, 48), 48)
    assert sizes(folder, 4) == ("images_4", (8, 12), 12)
    assert sizes(folder, 8) == ("images", (4, 6), 6)
    (folder / "images").rename(folder / "elsewhere")
    assert sizes(folder, 1) == sizes(folder, 4) == ("images_4", (8, 12), 12)
    assert sizes(folder, 8) == ("images_4", (4, 6), 6)
    assert any("4 times smaller than full size" in note for note in read(folder).notes)
    assert not read(folder, 4).notes


def test_incomplete_folders_are_passed_over(folder: Path) -> None:
    photos(folder / "images_8", (6, 4), 2)
    assert sizes(folder, 8) == ("images", (4, 6), 6)
    assert f"{folder / 'images_8'} has 2 of 5 photos and is passed over" in read(folder).notes
    (folder / "images/image001.png").unlink()
    with pytest.raises(UserError, match=r"has 5 rows, but no folder as many photos \(images has 4, images_8 has 2\)"):
        read(folder)
    for name in ("images", "images_8"):
        (folder / name).rename(folder / f"x{name}")
    with pytest.raises(UserError, match="no folder images or images_4"):
        read(folder)


def header(text: str) -> bytes:
    padded = text + " " * (117 - len(text)) + "\n"
    return b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded.encode()


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "is not an array that NumPy can read"),
        (b"<html>", "is not an array that NumPy can read"),
        (b"\x93NUMPY\x01\x00", "is not an array that NumPy can read"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000, 17)}"), "its header claims 1,2"),
        (header("{'descr': '|O', 'fortran_order': False, 'shape': (5, 17)}") + b"cos\nsystem", "'object' values"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-5, 17)}"), "has the shape"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': ((((("), "is not an array that NumPy can read"),
    ],
)
def test_files_that_are_no_table_are_named(folder: Path, content: bytes, text: str) -> None:
    (folder / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(UserError, match=text) as caught:
        read(folder)
    assert "poses_bounds.npy" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_values_that_are_no_cameras_are_named(folder: Path) -> None:
    def refused(column: int | slice, value: float, text: str) -> None:
        array = table()
        array[3, column] = value
        write(folder, array)
        with pytest.raises(UserError, match=text):
            read(folder)

    refused(4, 0, "row 3 has height 0, width 48, focal length 60")
    refused(14, -60, "row 3 has height 32, width 48, focal length -60")
    refused(8, np.nan, "row 3, column 8 is nan: a number")
    refused(3, 1e300, r"row 3, column 3 is 1e\+300")
    refused(15, -1, r"row 3 has the depth bounds -1 … 8: 0 < near < far")
    refused(16, 2, "row 3 has the depth bounds 2 … 2")
    refused(slice(0, 3), 0, "axes of row 3 are sheared, singular or mirrored")
    write(folder, table()[:, :16])
    with pytest.raises(UserError, match=r"shape \(5, 16\): one row of 17 numbers"):
        read(folder)
    write(folder, table()[:4])
    with pytest.raises(UserError, match="has 4 rows, but no folder as many photos"):
        read(folder)
    mirrored = table()
    mirrored[2, :15].reshape(3, 5)[:, 0] *= -1
    write(folder, mirrored)
    with pytest.raises(UserError, match="axes of row 2"):
        read(folder)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4), st.integers(0, 10**6))
def test_damaged_files_only_raise_user_errors(tmp_path: Path, flips: list[tuple[int, int]], cut: int) -> None:
    stream = io.BytesIO()
    np.save(stream, table())
    data = bytearray(stream.getvalue())
    for place, value in flips:
        data[place % 160 if place % 2 else place % len(data)] = value  # half of them in the header
    file = tmp_path / "poses_bounds.npy"
    file.write_bytes(data[: len(data) - (cut % len(data) if cut % 3 == 0 else 0)])
    try:
        values = read_table(file)
    except UserError as error:
        message = str(error)
    else:
        message = ""
        assert np.isfinite(values).all()
    assert "\n" not in message


def test_fern(scenes: Path) -> None:
    scene = load_scene(scenes / "fern", LoadOptions(downscale=8))
    assert (scene.format, len(scene.views), scene.images[0].shape) == ("llff", 20, (378, 504, 3))
    assert scene.views[0].name == "images_8/image000.png"
    assert scene.splits["test"] == (0, 8, 16)
    assert scene.ndc is not None
    assert (scene.ndc.width, scene.ndc.height) == (504, 378)
    assert scene.ndc.focal == pytest.approx(3260.52633 / 8)
    assert not scene.notes
