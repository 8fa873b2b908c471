"""Polycam's raw data: which of two folders is taken, and wrong values."""

import json
import shutil
from pathlib import Path

import pytest
from exports import COUNT, write_polycam

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions


def read(folder: Path) -> Capture:
    return DATASETS.get("polycam").read(folder, LoadOptions())


def test_corrected_photos_come_first_and_only_with_their_poses(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    write_polycam(tmp_path, "")
    capture = read(tmp_path)
    assert [photo.name for photo in capture.photos] == [f"corrected_images/{1000 + k}.jpg" for k in range(COUNT)]
    assert capture.up is not None
    assert capture.up.tolist() == [0, 1, 0]
    assert [photo.path for photo in read(tmp_path / "keyframes").photos] == [photo.path for photo in capture.photos]
    shutil.rmtree(tmp_path / "keyframes/corrected_images")
    capture = read(tmp_path)
    assert [photo.name for photo in capture.photos] == [f"images/{1000 + k}.jpg" for k in range(COUNT)]
    assert "no corrected_cameras with corrected_images" in capture.notes[0]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"t_00": None}, "t_00 is missing"),
        ({"t_13": "3"}, "t_13 is '3': a number"),
        ({"t_00": 9.0, "t_11": 0.1}, "sheared|singular|mirrored"),
        ({"fx": 0}, "fx is 0: a number above 0"),
        ({"fy": 1e-9}, "focal length 1e-09 .* no lens sees that wide"),
        ({"width": 24.5}, "width is 24.5: a whole number"),
        ({"cx": 1e300}, r"cx is 1e\+300: a number between"),
    ],
)
def test_wrong_values_are_named(tmp_path: Path, change: dict[str, object], text: str) -> None:
    file = write_polycam(tmp_path)
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(UserError, match=rf"1000\.json.*({text})"):
        read(tmp_path)
