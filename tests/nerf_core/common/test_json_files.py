import json
from pathlib import Path

import numpy as np
import pytest

from nerf_core.common.errors import UserError
from nerf_core.common.json_files import Fields, read_json, scaled_note


def written(tmp_path: Path, data: bytes) -> Path:
    (tmp_path / "t.json").write_bytes(data)
    return tmp_path / "t.json"


@pytest.mark.parametrize(
    "data",
    [
        b'{"a": "http://x // y", "b": 2}',
        b'\xef\xbb\xbf{"a": "http://x // y", "b": 2}',
        '{"a": "http://x // y", "b": 2}'.encode("utf-16"),
        b'// made by hand\n{"a": "http://x // y", // "c": 3,\n "b": 2}\n// end',
    ],
)
def test_byte_order_marks_and_comments_are_accepted(tmp_path: Path, data: bytes) -> None:
    assert read_json(written(tmp_path, data)).values == {"a": "http://x // y", "b": 2}


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "is empty"),
        (b" \n ", "is empty"),
        (b"<!DOCTYPE html><html>", "is a web page, not JSON"),
        (b'{"frames": [{"file_path": ', "breaks off or is no JSON at line 1"),
        (b'{"a": "\xff\xfe\xfd"}', "is not text"),
        (b"[1, 2]", "an object with frames is needed"),
        (b'{"a": {"b": [1, NaN]}}', r"a\.b\[1\]' is nan: a finite number is needed"),
        (b'{"fl_x": Infinity}', "'fl_x' is inf"),
        (b'{"fl_x": -1e999}', "'fl_x' is -inf"),
        (b'{"w": ' + b"7" * 5000 + b"}", "'w' is inf"),
        (b"[" * 200_000, "nested too deeply"),
        (b'{"a": ' * 200_000, "nested too deeply"),
        (b'"' * 200_001 + b"//", "no JSON"),
        (b'"' + b'\\"' * 100_000 + b"//", "no JSON"),
    ],
)
def test_broken_files_are_reported_in_one_line(tmp_path: Path, data: bytes, text: str) -> None:
    with pytest.raises(UserError, match=text) as caught:
        read_json(written(tmp_path, data))
    assert "t.json" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_folders_and_huge_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not a regular file"):
        read_json(tmp_path)
    with (tmp_path / "t.json").open("wb") as file:
        file.truncate(10**10)  # sparse: takes no disk
    with pytest.raises(UserError, match="10,000,000,000 bytes"):
        read_json(tmp_path / "t.json")


@pytest.mark.parametrize("value", ["7", True, [7], {"a": 7}, 1e13, -1e13, int("9" * 200)])
def test_number_wants_a_number(value: object) -> None:
    with pytest.raises(UserError, match=r"f\.json: frames\[3\]\.w is .*a number.* is needed"):
        Fields({"w": value}, Path("f.json"), "frames[3].").number("w")


def test_typed_access() -> None:
    fields = Fields({"w": 24.0, "h": 1.5, "z": 0, "none": None, "t": "x", "e": "", "l": ["a", 1]}, Path("f.json"))
    assert fields.count("w") == 24
    assert fields.number("none", 3.0) == 3.0
    assert fields.text("t") == "x"
    for access, text in (
        (lambda: fields.count("h"), "h is 1.5: a whole number is needed"),
        (lambda: fields.positive("z"), "z is 0: a number above 0 is needed"),
        (lambda: fields.number("absent"), "absent is missing: add it"),
        (lambda: fields.text("e"), "e is '': a text is needed"),
        (lambda: fields.texts("l"), "a list of texts is needed"),
        (lambda: fields.children("l"), r"l\[0\] is 'a': an object is needed"),
        (lambda: fields.children("absent"), "absent is None: a list with at least one entry is needed"),
    ):
        with pytest.raises(UserError, match=text):
            access()


def pose(rotation: object, rows: int = 4) -> tuple[np.ndarray, float]:
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(rotation)
    matrix[:3, 3] = (1, 2, 3)
    return Fields({"m": json.loads(json.dumps(matrix[:rows].tolist()))}, Path("f.json")).pose("m")


def test_poses_of_three_and_four_rows_lose_scale_but_not_position() -> None:
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    for rows in (3, 4):
        c2w, length = pose(2.5 * rotation, rows)
        np.testing.assert_allclose(c2w, np.column_stack([rotation, (1, 2, 3)]), atol=1e-12)
        assert length == pytest.approx(2.5)
    rounded, length = pose(np.round(rotation, 5))
    np.testing.assert_allclose(rounded[:, :3] @ rounded[:, :3].T, np.eye(3), atol=1e-12)
    assert scaled_note(Path("f"), [length]) == []
    assert "1 pose has scaled axes (length 2.5)" in scaled_note(Path("f"), [1.0, 2.5])[0]


@pytest.mark.parametrize(
    ("rotation", "text"),
    [
        (np.zeros((3, 3)), "singular"),
        (np.diag([1, 1, 0]), "singular"),
        (np.diag([1, 1, 1e-9]), "singular"),
        (np.diag([1, 1, -1]), "mirrored"),
        (np.diag([1, 1, 2]), "sheared"),
    ],
)
def test_a_matrix_that_is_no_rotation_is_refused(rotation: np.ndarray, text: str) -> None:
    with pytest.raises(UserError, match=text):
        pose(rotation)


@pytest.mark.parametrize(
    "matrix",
    [None, 3, [], [[1, 0, 0, 0]] * 2, [[1, 0, 0]] * 3, [[1, 0, 0, "0"]] * 3, [[1, 0, 0, True]] * 3, [[1e300] * 4] * 3],
)
def test_a_value_that_is_no_matrix_is_refused(matrix: object) -> None:
    with pytest.raises(UserError, match=r"f\.json: m .*needed"):
        Fields({"m": matrix}, Path("f.json")).pose("m")


def test_last_row_must_be_homogeneous() -> None:
    matrix = np.eye(4)
    matrix[3, 3] = 2
    with pytest.raises(UserError, match="the last row is 0, 0, 0, 1"):
        Fields({"m": matrix.tolist()}, Path("f.json")).pose("m")
