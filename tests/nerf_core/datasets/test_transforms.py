import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, Lens

Document = dict[str, Any]
Folder = tuple[Path, Document]
Read = Callable[[Document], Capture]


def test_global_intrinsics_and_sorted_photos(transforms_folder: Folder, read_transforms: Read) -> None:
    document = transforms_folder[1]
    document |= {"k1": 0.1, "k2": -0.02, "k3": 0.003, "p1": 0.004, "p2": -0.005, "camera_model": "OPENCV"}
    document["frames"].reverse()
    capture = read_transforms(document)
    assert [p.name for p in capture.photos] == [f"images/{i:04}.png" for i in range(10)]
    camera = capture.photos[2].camera
    assert camera.intrinsics() == (24, 16, 30.0, 31.0, 12.5, 7.5, 0.1, -0.02, 0.003, 0.004, -0.005, 0, 0, 0, 0)
    np.testing.assert_allclose(camera.c2w, np.array(document["frames"][7]["transform_matrix"])[:3], atol=1e-12)
    assert (capture.splits, capture.near, capture.synthetic, capture.notes) == (None, None, False, ())


def test_fisheye_and_equirectangular_pictures(transforms_folder: Folder, read_transforms: Read) -> None:
    document = transforms_folder[1] | {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": 0.4}
    fisheye = read_transforms(document).photos[0].camera
    assert fisheye.lens == Lens(k1=0.1, k2=-0.02, k3=0.003, k4=0.4, kind=FISHEYE)
    del document["camera_model"]
    assert read_transforms(document | {"is_fisheye": True}).photos[0].camera.lens == fisheye.lens
    for key in ("k1", "k2", "k3", "k4", "cx", "cy"):
        document.pop(key)
    document |= {"camera_model": "EQUIRECTANGULAR", "h": 12, "fl_x": 12, "fl_y": 12}
    around = read_transforms(document).photos[0].camera
    assert around.intrinsics() == pytest.approx((24, 12, 12 / math.pi, 12 / math.pi, 12, 6, *[0] * 8, EQUIRECTANGULAR))
    for key in ("fl_x", "fl_y"):
        document.pop(key)
    assert read_transforms(document).photos[0].camera.intrinsics() == around.intrinsics()


def test_frames_may_have_their_own_lens_and_angles(transforms_folder: Folder, read_transforms: Read) -> None:
    document = transforms_folder[1]
    document["frames"][1] |= {"fl_x": 50.0, "cx": 3.0, "w": 48, "h": 32}
    for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
        document.pop(key)
    document["camera_angle_x"] = 0.8
    cameras = [p.camera for p in read_transforms(document).photos]
    assert cameras[1].intrinsics()[:6] == (48, 32, 50.0, 50.0, 3.0, 16.0)
    focal = 12 / math.tan(0.4)
    assert cameras[0].intrinsics()[:6] == pytest.approx((24, 16, focal, focal, 12, 8))
    document["camera_angle_y"] = 0.9
    assert read_transforms(document).photos[0].camera.fy == pytest.approx(8 / math.tan(0.45))


def test_nerfstudio_splits(transforms_folder: Folder, read_transforms: Read) -> None:
    document = transforms_folder[1]
    listed = [f["file_path"] for f in document["frames"]]
    document |= {"train_filenames": listed[5:], "val_filenames": [listed[0], "gone.png"], "applied_transform": [[1]]}
    capture = read_transforms(document)
    assert capture.splits == {"train": (1, 2, 3, 4, 5), "val": (0,)}
    assert [p.name for p in capture.photos] == [listed[0], *listed[5:]]
    assert "1 names of its splits are in no frame, first 'gone.png'" in capture.notes[0]
    assert "4 photos in no split, left out" in capture.notes[1]
    del document["train_filenames"]
    with pytest.raises(UserError, match="train_filenames is missing beside val_filenames"):
        read_transforms(document)


def test_missing_and_double_photos_are_noted(transforms_folder: Folder, read_transforms: Read) -> None:
    folder, document = transforms_folder
    (folder / "images/0003.png").unlink()
    (folder / "images/0004.png").write_bytes(b"")
    document["frames"].append(copy.deepcopy(document["frames"][0]))
    capture = read_transforms(document)
    assert len(capture.photos) == 9  # the damaged photo is noticed only when its size is needed
    assert "1 of 11 listed photos are missing, first 'images/0003.png'" in capture.notes[0]
    assert "1 photo listed more than once (first images/0000.png)" in capture.notes[1]
    del document["w"]
    capture = read_transforms(document)
    assert len(capture.photos) == 8
    assert any("1 damaged photo is skipped" in note and "0004.png" in note for note in capture.notes)


def test_scaled_poses_bounds_and_one_frame(transforms_folder: Folder, read_transforms: Read) -> None:
    document = transforms_folder[1] | {"near": 0.5, "far": 9}
    document["frames"] = document["frames"][:1]
    matrix = np.array(document["frames"][0]["transform_matrix"])
    document["frames"][0]["transform_matrix"] = (matrix * (3, 3, 3, 1))[:3].tolist()
    capture = read_transforms(document)
    assert (capture.near, capture.far) == (0.5, 9)
    np.testing.assert_allclose(capture.photos[0].camera.c2w, matrix[:3], atol=1e-12)
    assert "scaled axes (length 3)" in capture.notes[0]
    assert capture.named_splits() == {"train": (0,)}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"frames": []}, "frames is .*at least one entry"),
        ({"frames": [3]}, r"frames\[0\] is 3: an object is needed"),
        ({"frames": [{}]}, r"frames\[0\]\.file_path is None: a text"),
        ({"frames": [{"file_path": "a"}]}, r"frames\[0\]\.transform_matrix is None: a matrix"),
        ({"fl_x": 0}, "fl_x is 0: a number above 0"),
        ({"fl_x": None, "fl_y": None}, "fl_x and camera_angle_x are missing"),
        ({"fl_x": None, "camera_angle_x": 3.2}, "camera_angle_x is 3.2: an angle below"),
        ({"fl_x": 1e-9}, "no lens sees that wide"),
        ({"w": 0}, "w is 0: a number above 0"),
        ({"w": 24.5}, "w is 24.5: a whole number"),
        ({"k1": "0"}, "k1 is '0': a number is needed"),
        ({"camera_model": "FISHEYE624"}, "camera_model is 'FISHEYE624': known are PINHOLE"),
        ({"camera_model": 3}, "camera_model is 3: a text"),
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "is_fisheye is True: but camera_model is OPENCV"),
        ({"k4": 0.1}, "k4 is 0.1: the lens OPENCV has no such coefficient"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 is 0.1: the lens OPENCV_FISHEYE has no such"),
        ({"camera_model": "EQUIRECTANGULAR", "k1": 0.1}, "k1 is 0.1: the lens EQUIRECTANGULAR has no such"),
        ({"camera_model": "EQUIRECTANGULAR", "fl_x": 3}, "fl_x is 3: at least 12 is needed"),
        ({"camera_model": "OPENCV_FISHEYE", "fl_x": None, "camera_angle_x": 1}, "camera_angle_x is 1: the focal"),
        ({"near": 3, "far": 2}, "far is 2: a number above near"),
        ({"near": 3}, "far is missing"),
        ({"train_filenames": "a"}, "train_filenames is 'a': a list of texts"),
    ],
)
def test_wrong_fields_are_named(transforms_folder: Folder, read_transforms: Read, change: Document, text: str) -> None:
    with pytest.raises(UserError, match=rf"transforms\.json: .*{text}"):
        read_transforms(transforms_folder[1] | change)


def test_a_file_of_any_name_can_be_opened(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    (folder / "transforms.json").rename(folder / "mine.json")
    transforms = DATASETS.get("transforms")
    assert transforms.matches(folder / "mine.json")
    assert not transforms.matches(folder)
    assert len(transforms.read(folder / "mine.json", LoadOptions()).photos) == 10
