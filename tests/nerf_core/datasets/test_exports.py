"""What the readers of other programs' exports have in common: recognition, poses, photos, and refusals in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports import CENTER, COUNT, FOCAL, POSES, SIZE, WRITERS, Y_UP

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, LoadOptions, load_scene

AUTO = LoadOptions()


@pytest.fixture(params=list(WRITERS))
def export(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, Path]:
    """The format's name, its folder, and the file with poses."""
    return request.param, tmp_path, WRITERS[request.param](tmp_path)


def refusal(name: str, folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        DATASETS.get(name).read(folder, AUTO)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600
    return str(caught.value)


def photos(folder: Path) -> list[Path]:
    return sorted(f for f in folder.rglob("*") if f.suffix.lower() in (".jpg", ".png"))


def test_poses_and_calibration_are_those_of_the_export(export: tuple[str, Path, Path]) -> None:
    name, folder, _ = export
    matching = [n for n in DATASETS.names() if DATASETS.get(n).matches(folder)]
    assert matching == [name]
    capture = DATASETS.get(name).read(folder, AUTO)
    assert (capture.format, capture.notes, len(capture.photos)) == (name, (), COUNT)
    for photo, pose in zip(capture.photos, POSES, strict=True):
        camera = photo.camera
        np.testing.assert_allclose(camera.c2w, pose[Y_UP] if name == "polycam" else pose, atol=1e-9)
        fy = FOCAL[0] if name == "realitycapture" else FOCAL[1]
        assert camera.intrinsics()[:6] == pytest.approx((*SIZE, FOCAL[0], fy, *CENTER))


def test_the_scene_is_loaded_and_held_out_as_others_are(export: tuple[str, Path, Path]) -> None:
    name, folder, _ = export
    scene = load_scene(folder, AUTO)
    assert (scene.format, len(scene.views)) == (name, COUNT)
    assert {len(v) for v in scene.splits.values()} == {1, COUNT - 1}
    offsets = np.array([view.camera.c2w[:, 3] for view in scene.views])
    np.testing.assert_allclose(offsets[:, 2], offsets[0, 2], atol=1e-6)  # a horizontal ring, whatever way was up


def test_missing_damaged_and_outside_photos(export: tuple[str, Path, Path]) -> None:
    name, folder, _ = export
    files = photos(folder)
    outside = folder.with_name(folder.name + " outside")
    outside.mkdir()
    files[0].rename(outside / files[0].name)
    files[0].symlink_to(outside / files[0].name)
    files[1].unlink()
    capture = DATASETS.get(name).read(folder, AUTO)
    assert len(capture.photos) == COUNT - 1
    assert any("missing" in note or "has 4 poses" in note for note in capture.notes)
    files[2].write_bytes(b"")
    assert len(load_scene(folder, AUTO).views) == COUNT - 2
    for file in photos(folder):
        file.unlink()
    refusal(name, folder)


@pytest.mark.parametrize("data", [b"", b" \n", b"<html>", b"\xff\xfe\xff", b"\x00" * 50, b"{}", b"[" * 200_000])
def test_other_files_are_refused_in_one_line(export: tuple[str, Path, Path], data: bytes) -> None:
    name, folder, file = export
    head = {"metashape": b"<document><chunk", "realitycapture": b"#name,heading,pitch,roll,px,py,k1"}.get(name, b"")
    file.write_bytes(head + data if data.strip() else data)
    refusal(name, folder)


def test_files_too_large_and_devices_are_refused(export: tuple[str, Path, Path]) -> None:
    name, folder, file = export
    with file.open("r+b") as stream:
        stream.truncate(100_000_000)  # sparse
    assert "no calibration is that large" in refusal(name, folder)
    file.unlink()
    file.mkdir()
    refusal(name, folder)
