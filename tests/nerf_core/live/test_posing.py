"""A window opens photos that have no poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import textured_photos
from desk import Desk

from nerf_core.captures.records import STAGES
from nerf_core.common.language import said, use_language
from nerf_core.datasets import LoadOptions
from nerf_core.live.messages import CancelLoading, OpenScene

OpenDesk = Callable[..., Desk]


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return textured_photos.write(tmp_path / "photos", textured_photos.arc())


def test_poses_are_found_and_training_begins(open_desk: OpenDesk, photos: Path, tmp_path: Path) -> None:
    desk = open_desk(opened=False, steps=3)
    settings = replace(desk.settings, load=LoadOptions(downscale=8, poses="fast"))
    desk.send(OpenScene(photos, settings, train=True))
    shown = desk.until(lambda s: s.posing is not None and s.posing.stage == STAGES["features"])
    assert shown.status == "loading"
    assert shown.posing is not None
    assert shown.posing.photos == 8
    use_language("ru")
    try:
        assert "поиск" in said(shown.loading)
    finally:
        use_language("en")
    shown = desk.until(lambda s: s.status == "finished")
    assert shown.posing is None
    assert shown.scene is not None
    assert shown.scene.posed.startswith("8 of 8 photos have a pose; ")
    assert (len(shown.scene.views), shown.scene.name) == (8, "photos")


def test_a_search_that_is_cancelled_leaves_what_was_open(open_desk: OpenDesk, photos: Path, tmp_path: Path) -> None:
    desk = open_desk()
    before = desk.worker.snapshot().scene
    desk.send(OpenScene(photos, replace(desk.settings, load=LoadOptions(poses="fast"))))
    desk.until(lambda s: s.posing is not None and s.posing.stage == STAGES["features"])
    desk.send(CancelLoading())
    desk.until_told("loading was cancelled")
    shown = desk.until(lambda s: s.status == "ready")
    assert shown.scene is before
    assert shown.posing is None
    assert not list((tmp_path / "cache").rglob("poses/*"))


def test_photos_without_poses_are_told_why(open_desk: OpenDesk, tmp_path: Path, photos: Path) -> None:
    desk = open_desk(opened=False)
    bad = textured_photos.write(tmp_path / "bad", textured_photos.arc(4), list(range(4)))
    desk.send(OpenScene(bad, replace(desk.settings, load=LoadOptions(poses="fast"))))
    assert desk.until_told("no poses were found for its 4 photos").level == "error"
