"""Record3D's export: numbers of photos, the unpacked .r3d file, and wrong values."""

import json
from pathlib import Path
from typing import Any

import pytest
from captures import write_photo
from exports import COUNT, record3d_document, write_record3d

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions


def read(folder: Path) -> Capture:
    return DATASETS.get("record3d").read(folder, LoadOptions())


def test_an_unpacked_r3d_file_is_read(tmp_path: Path) -> None:
    write_record3d(tmp_path, "metadata", "rgbd")
    assert DATASETS.get("record3d").matches(tmp_path)
    assert [photo.name for photo in read(tmp_path).photos] == [f"rgbd/{k}.jpg" for k in range(COUNT)]


def test_photos_have_the_pose_of_their_number(tmp_path: Path) -> None:
    file = write_record3d(tmp_path)
    document = record3d_document()
    document["poses"] = document["poses"] * 3
    file.write_text(json.dumps(document))
    for k in (10, 11, 99):
        write_photo(tmp_path / f"rgb/{k}.jpg")
    capture = read(tmp_path)
    assert [photo.name for photo in capture.photos] == [f"rgb/{k}.jpg" for k in (0, 1, 2, 3, 10, 11)]
    assert (capture.photos[4].camera.c2w == capture.photos[2].camera.c2w).all()
    assert f"{file} has 12 poses, and {tmp_path / 'rgb'} 7 photos" in capture.notes[0]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"poses": []}, "poses is .*at least one entry"),
        ({"poses": [[1, 0, 0, 0, 0, 0]]}, r"poses\[0\] is .*7 numbers"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]]}, r"poses\[0\] is a quaternion of length 0"),
        ({"poses": [[0, 0, 0, "1", 1, 2, 3]]}, r"poses\[0\] is .*7 numbers"),
        ({"poses": [[0, 0, 0, True, 1, 2, 1e300]]}, r"poses\[0\] is .*7 numbers"),
        ({"K": [[1, 2, 3]] * 3}, "K is .*9 numbers"),
        ({"K": [0] * 9}, "focal length 0"),
        ({"K": None}, "K is None: 9 numbers"),
        ({"w": None}, "w is missing"),
        ({"h": 0}, "h is 0: a number above 0"),
    ],
)
def test_wrong_values_are_named(tmp_path: Path, change: dict[str, Any], text: str) -> None:
    write_record3d(tmp_path).write_text(json.dumps(record3d_document() | change))
    with pytest.raises(UserError, match=rf"metadata\.json.*{text}"):
        read(tmp_path)
