"""Changed JSON gives a scene or a UserError of one line, nothing else."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, LoadOptions, load_scene

SETTINGS = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # every example writes the file anew
)
VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**400), 10**400),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(["../..", "/dev/null", "images", "OPENCV", 0, -1, 1e-300, 1e300, 1e11, [], {}, [[]], [0] * 4]),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [p for key, child in children for p in places(child, (*path, key))]


def check(folder: Path, text: bytes) -> None:
    (folder / "transforms.json").write_bytes(text)
    try:
        scene = load_scene(folder, LoadOptions())
    except UserError as error:
        message = str(error)
    else:
        message = ""
        assert len(scene.views) == len(scene.images) > 0
    assert "\n" not in message
    assert len(message) < 1000


@pytest.fixture
def document(transforms_folder: tuple[Path, dict[str, Any]]) -> dict[str, Any]:
    document = transforms_folder[1]
    document["frames"] = document["frames"][:3]
    extra = {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_angle_x": 0.7, "camera_model": "OPENCV"}
    return document | extra | {"train_filenames": [f["file_path"] for f in document["frames"]]}


@SETTINGS
@given(data=st.data())
def test_changed_values(transforms_folder: tuple[Path, Any], document: dict[str, Any], data: st.DataObject) -> None:
    changed = copy.deepcopy(document)
    for _ in range(data.draw(st.integers(1, 3))):
        *way, last = data.draw(st.sampled_from(places(changed)))
        holder: Any = changed
        for key in way:
            holder = holder[key]
        if data.draw(st.booleans()):
            del holder[last]
        else:
            holder[last] = data.draw(VALUES)
        if not places(changed):
            break
    check(transforms_folder[0], json.dumps(changed).encode())


@SETTINGS
@given(data=st.data())
def test_changed_bytes(transforms_folder: tuple[Path, Any], document: dict[str, Any], data: st.DataObject) -> None:
    text = json.dumps(document).encode()
    start = data.draw(st.integers(0, len(text)))
    end = start + data.draw(st.integers(0, 40))
    check(transforms_folder[0], text[:start] + data.draw(st.binary(max_size=6)) + text[end:])


@SETTINGS
@given(data=st.data())
def test_truncated_blender_files(blender_folder: tuple[Path, dict[str, Any]], data: st.DataObject) -> None:
    folder, documents = blender_folder
    text = json.dumps(documents["train"])
    (folder / "transforms_train.json").write_text(text[: data.draw(st.integers(0, len(text) - 1))])
    with pytest.raises(UserError, match=r"transforms_train\.json"):
        DATASETS.get("blender").read(folder, LoadOptions())
