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
from nerf_core.training.evaluate import evaluate, picture_path, select
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
        both = np.asarray(Image.open(tmp_path / image["name"]))
        assert np.array_equal(both, np.concatenate([to_bytes(color), to_bytes(truth)], 1))
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


def test_pictures_keep_the_photos_names() -> None:
    names = {"test/r_0.png": "test/r_0.png", "a/b.jpg": "a/b.jpg.png", "a/b": "a/b.png"}
    assert {n: picture_path(Path("e"), n).relative_to("e").as_posix() for n in names} == names


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
