import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, LoadOptions, load_scene

Folder = tuple[Path, dict[str, dict[str, Any]]]
BLENDER = DATASETS.get("blender")


def rewrite(folder: Path, split: str, document: object) -> None:
    import json

    (folder / f"transforms_{split}.json").write_text(json.dumps(document))


def test_splits_cameras_and_bounds(blender_folder: Folder) -> None:
    folder, documents = blender_folder
    capture = BLENDER.read(folder, LoadOptions())
    assert capture.splits == {"train": (0, 1, 2, 3), "val": (4, 5), "test": (6, 7, 8)}
    assert [capture.photos[i].name for i in (0, 4, 8)] == ["train/r_0.png", "val/r_0.png", "test/r_2.png"]
    camera = capture.photos[8].camera
    assert camera.intrinsics()[:6] == pytest.approx((16, 16, 8 / math.tan(0.35), 8 / math.tan(0.35), 8, 8))
    np.testing.assert_allclose(camera.c2w, np.array(documents["test"]["frames"][2]["transform_matrix"])[:3], atol=1e-12)
    assert (capture.near, capture.far, capture.synthetic) == (2, 6, True)
    rewrite(folder, "train", documents["train"] | {"near": 1.5, "far": 9.5, "fl_x": 20, "w": 16, "h": 16})
    capture = BLENDER.read(folder, LoadOptions())
    assert (capture.near, capture.far, capture.photos[0].camera.fx) == (1.5, 9.5, 20)


def test_a_photo_may_serve_two_splits(blender_folder: Folder) -> None:
    folder, documents = blender_folder
    rewrite(folder, "val", documents["test"])
    capture = BLENDER.read(folder, LoadOptions())
    assert capture.splits == {"train": (0, 1, 2, 3), "val": (4, 5, 6), "test": (4, 5, 6)}
    assert capture.notes == ()


def test_a_missing_photo_does_not_come_from_another_split(blender_folder: Folder) -> None:
    folder, _ = blender_folder
    (folder / "train/r_2.png").unlink()
    capture = BLENDER.read(folder, LoadOptions())
    assert capture.splits == {"train": (0, 1, 2), "val": (3, 4), "test": (5, 6, 7)}
    assert "1 of 9 listed photos are missing" in capture.notes[0]
    shutil.rmtree(folder / "train")
    assert BLENDER.read(folder, LoadOptions()).splits == {"train": (), "val": (0, 1), "test": (2, 3, 4)}


def test_training_file_is_needed(blender_folder: Folder) -> None:
    folder, _ = blender_folder
    (folder / "transforms_train.json").unlink()
    assert BLENDER.matches(folder)
    with pytest.raises(UserError, match=r"transforms_train.json does not exist: Blender's format needs it"):
        BLENDER.read(folder, LoadOptions())


def test_any_of_its_files_opens_the_folder(blender_folder: Folder) -> None:
    folder, _ = blender_folder
    assert BLENDER.matches(folder / "transforms_val.json")
    assert not BLENDER.matches(folder / "train/r_0.png")
    assert len(BLENDER.read(folder / "transforms_val.json", LoadOptions()).photos) == 9


def test_an_object_in_another_unit_is_the_same_scene(blender_folder: Folder) -> None:
    folder, documents = blender_folder
    for frame in (f for document in documents.values() for f in document["frames"]):
        frame["transform_matrix"] = np.array(frame["transform_matrix"])
    found = []
    for unit in (1.0, 1e-3, 1e3):
        for split, document in documents.items():
            frames = [{**f, "transform_matrix": f["transform_matrix"].copy()} for f in document["frames"]]
            for frame in frames:
                frame["transform_matrix"][:3, 3] /= unit
                frame["transform_matrix"] = frame["transform_matrix"].tolist()
            rewrite(folder, split, {**document, "frames": frames})
        found.append(load_scene(folder, LoadOptions()))
    metres, *others = found
    assert (metres.near, metres.far, metres.notes) == (2, 6, ())
    for scene, unit in zip(others, (1e-3, 1e3), strict=True):
        distance = np.linalg.norm(scene.center - scene.poses[0, :, 3])
        ratio = (scene.near + scene.far) / 2 / distance  # the bounds lie about the focus as those of metres do about 4
        assert ratio == pytest.approx(1, rel=0.05)
        assert scene.far / scene.near == pytest.approx(3)
        size = distance / np.linalg.norm(metres.center - metres.poses[0, :, 3])
        np.testing.assert_allclose(scene.poses[:, :, 3], size * metres.poses[:, :, 3], atol=1e-9)
        assert 3 < scene.radius < 5
        np.testing.assert_allclose(scene.to_input[:3, :3] * size * unit, np.eye(3), atol=1e-9)
        assert any("look at a point" in note for note in scene.notes)
