"""Metrics of a run: which photos, which numbers, which pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene
from nerf_core.rendering.images import render_camera, to_bytes
from nerf_core.training.eval_pictures import PAGE, picture_names, side_by_side
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.metrics import psnr, ssim
from nerf_core.training.trainer import Trainer

Make = Callable[..., Trainer]


def with_splits(scene: Scene, **splits: tuple[int, ...]) -> Scene:
    return replace(scene, splits=splits)


def test_selection_prefers_test_then_val_then_every_eighth(scene: Scene) -> None:
    assert select(with_splits(scene, train=(0,), val=(1,), test=(2, 3))).views == (2, 3)
    val = select(with_splits(scene, train=(0,), val=(1,), test=()))
    assert (val.split, val.views, val.subset) == ("val", (1,), None)
    train = select(with_splits(scene, train=tuple(range(20))))
    assert (train.split, train.views, train.subset) == ("train", (0, 8, 16), "every 8th photo: 3 of 20")


def test_a_limited_selection_is_described(scene: Scene) -> None:
    many = with_splits(scene, train=(0,), test=tuple(range(10, 21)))
    assert select(many, count=11).subset is None
    few = select(many, count=3)
    assert (few.views, few.subset) == ((10, 15, 20), "3 of 11 photos, evenly spread")


def test_wrong_selections(scene: Scene) -> None:
    with pytest.raises(UserError, match=r"--split 'val': ball has no such photos, but train \(5\), test \(1\)"):
        select(scene, "val")
    with pytest.raises(UserError, match="--views 0: give a whole number from 1 up"):
        select(scene, count=0)


def test_metrics_are_those_of_the_float_picture(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer()
    trainer.step()
    seen: list[tuple[int, float]] = []
    result = evaluate(
        trainer, select(trainer.scene, "train", 2), pictures=tmp_path, progress=lambda *at: seen.append(at)
    )
    assert list(result) == ["mean", "images", "split", "method", "step", "seconds", "subset"]
    assert (result["split"], result["method"], result["step"]) == ("train", "nerf", 1)
    assert [image["name"] for image in result["images"]] == ["0.png", "4.png"]
    for image, index in zip(result["images"], (0, 4), strict=True):
        color, _ = render_camera(trainer.method, trainer.scene.views[index].camera, trainer.scene)
        truth = trainer.scene.images[index].astype(np.float32) / 65535
        assert image["psnr"] == psnr(color, truth)
        assert image["ssim"] == ssim(color, truth)
        assert image["lpips"] is None
        sheet = np.asarray(Image.open(tmp_path / image["name"]))
        column = (sheet.shape[1] - 4 * 12) // 3  # the labels of small photos have 12 pixels, and so have the gaps
        parts = [sheet[2 * 12 : 2 * 12 + 16, 12 + k * (column + 12) :][:, :16] for k in range(2)]
        assert np.array_equal(parts[0], to_bytes(truth))
        assert np.array_equal(parts[1], to_bytes(color))
    for name in ("psnr", "ssim"):
        assert result["mean"][name] == pytest.approx(np.mean([image[name] for image in result["images"]]))
    assert result["mean"]["lpips"] is None
    assert seen[-1] == (1, 1.0)
    assert [fraction for _, fraction in seen] == sorted(fraction for _, fraction in seen)


def test_a_perfect_picture_is_finite_json(make_trainer: Make) -> None:
    trainer = make_trainer()
    color, _ = render_camera(trainer.method, trainer.scene.views[5].camera, trainer.scene)
    exact = np.round(color * 65535).astype(np.uint16)
    photos = Photos.of([*trainer.scene.images[:5], exact])
    trainer.scene = replace(trainer.scene, photos=photos)
    result = evaluate(trainer, select(trainer.scene))
    assert result["mean"]["psnr"] > 96  # 16 bits
    json.dumps(result, allow_nan=False)


def test_cancelled_between_tiles(make_trainer: Make, tmp_path: Path) -> None:
    def cancel(done: int, fraction: float) -> None:
        raise KeyboardInterrupt

    trainer = make_trainer()
    with pytest.raises(KeyboardInterrupt):
        evaluate(trainer, select(trainer.scene), pictures=tmp_path / "eval", progress=cancel)
    assert not (tmp_path / "eval").exists()


def test_photo_rendering_and_error_lie_apart_under_their_labels() -> None:
    rng = np.random.default_rng(0)
    truth = rng.random((30, 500, 3), np.float32)
    color = np.clip(truth + np.float32(0.1), 0, 1)
    color[5:] = truth[5:]
    mask = np.ones((30, 500), bool)
    mask[20:] = False
    sheet = side_by_side(color, truth, mask, 27.04)
    gap = (sheet.shape[1] - 3 * 500) // 4
    top = sheet.shape[0] - gap - 30
    parts = [sheet[top : top + 30, gap + k * (500 + gap) :][:, :500] for k in range(3)]
    assert gap > 8
    assert np.array_equal(parts[0], to_bytes(truth))
    assert np.array_equal(parts[1], to_bytes(color))
    assert (parts[2][5:20] == parts[2][5, 0]).all()  # no error
    assert parts[2][:5].mean() > parts[2][5:20].mean() + 50
    assert (parts[2][20:] == PAGE).all()
    for k in range(4):  # the gaps are empty, and every part has a label
        assert (sheet[top:, k * (500 + gap) :][:, :gap] == PAGE).all()
    assert all((sheet[:top, gap + k * (500 + gap) :][:, :500] != PAGE).any() for k in range(3))
    tiny = side_by_side(color[:8, :8], truth[:8, :8], None, 100.0)
    assert tiny.shape[1] > 3 * 100  # labels are wider than the photos, and none is cut


def test_errors_are_brighter_up_to_that_of_the_label() -> None:
    truth = np.zeros((30, 500, 3), np.float32)

    def brightness(error: float) -> float:
        return float(side_by_side(truth + np.float32(error), truth, None, 20.0)[-30:, -400:-100].mean())

    shown = [brightness(error) for error in (0, 0.05, 0.1, 0.2, 0.4)]
    assert shown[0] < shown[1] < shown[2] < shown[3] == shown[4]


def test_labels_can_be_read_when_a_sheet_fits_the_screen() -> None:
    for wide in (300, 800, 4000):
        photo = np.zeros((20, wide, 3), np.float32)
        sheet = side_by_side(photo, photo, None, 30.0)
        label = (sheet.shape[0] - 20) / 3  # a gap has the size of the label, and there are two more above the photos
        assert label * min(1, 1920 / sheet.shape[1]) > 10


def test_the_psnr_of_a_label_is_that_of_the_table(
    make_trainer: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured, labels = [], []
    monkeypatch.setattr("nerf_core.training.evaluate.psnr", lambda *pair: measured.append(pair) or 31.5)
    monkeypatch.setattr(
        "nerf_core.training.evaluate.side_by_side",
        lambda *sheet: labels.append(sheet[3]) or np.zeros((4, 4, 3), np.uint8),
    )
    trainer = make_trainer()
    result = evaluate(trainer, select(trainer.scene, "train", 2), pictures=tmp_path)
    assert [image["psnr"] for image in result["images"]] == labels == [31.5, 31.5]
    assert len(measured) == 2


def test_pictures_have_the_photos_names_with_one_suffix() -> None:
    plain = {"test/r_0.png": "test/r_0.png", "a/b.JPG": "a/b.png", "a/c": "a/c.png", "a/v1.2": "a/v1.2.png"}
    assert picture_names(list(plain)) == plain
    alike = {"a/b.jpg": "a/b.jpg.png", "a/b.tif": "a/b.tif.png", "c/b.jpg": "c/b.jpg.png"}
    assert picture_names(list(alike)) == alike


@pytest.mark.parametrize(
    "names",
    [
        ["a.jpg", "a.tif", "a.jpg.png"], ["A.jpg", "a.tif"], ["a.jpg", "A.jpg", "a.png"],
        ["a.jpg", "A.jpg", "A.JPG", "a.jpg-1"],
    ],
)  # fmt: skip
def test_no_two_pictures_share_a_file_on_any_disk(names: list[str]) -> None:
    files = picture_names(names)
    assert list(files) == names
    assert len({file.casefold() for file in files.values()}) == len(names)


def test_masked_pixels_are_not_counted(make_trainer: Make) -> None:
    trainer = make_trainer()
    scene, mask = trainer.scene, np.ones((16, 16), bool)
    mask[:, :4] = False
    trainer.scene = replace(scene, photos=scene.photos.masked({5: mask}))
    (image,) = evaluate(trainer, select(trainer.scene))["images"]
    color, _ = render_camera(trainer.method, scene.views[5].camera, scene)
    truth = scene.images[5].astype(np.float32) / 65535
    assert image["psnr"] == psnr(color[:, 4:], truth[:, 4:]) != psnr(color, truth)
    assert image["ssim"] == pytest.approx(ssim(color[:, 4:], truth[:, 4:]))
    assert image["masked"] == 0.25
