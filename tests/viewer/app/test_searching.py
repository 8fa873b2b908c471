"""While poses are found, and where none are found, the viewport shows the photos."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import scripted
from imgui_bundle import imgui

from nerf_core.captures.records import COPYING, MOST_SHOWN, PLACED, STAGES, PoseProgress, thumbnails_of
from nerf_core.live.messages import Notice, OpenScene, Snapshot
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.draw.mosaic import places
from viewer.window import Window

PHOTOS = tuple(np.full((60, 80, 4), (200, 40 * k, 0, 255), np.uint8) for k in range(6))
SEARCH = PoseProgress(STAGES["features"], 3, 6, 6, thumbnails=PHOTOS)


@pytest.fixture
def app(offscreen: Callable[..., Window]) -> Iterator[App]:
    app = App(offscreen((1280, 800), 1.0), scripted.ScriptedWorker())
    yield app
    app.close()


@pytest.fixture
def texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts of the bars and of the viewport."""
    found: list[str] = []
    colored, plain = imgui.text_colored, imgui.ImDrawList.add_text
    monkeypatch.setattr(imgui, "text_colored", lambda color, text: [found.append(text), colored(color, text)])
    monkeypatch.setattr(
        imgui.ImDrawList, "add_text", lambda self, *args: [found.append(args[-1]), plain(self, *args)][1]
    )
    return found


def shows(app: App, file: Path, **changes: Any) -> list[float]:
    """The brightness of each photo that the viewport shows, relative to its own; 0 where it is not seen."""
    assert isinstance(app.link, scripted.ScriptedWorker)
    app.link.current = replace(Snapshot(), **changes)
    app.settle()
    app.screenshot(file)
    assert app.state.viewport_rect is not None
    left, top, width, height = map(int, app.state.viewport_rect)
    picture = iio.imread(file)[top : top + height, left : left + width, :3].reshape(-1, 3).astype(float)
    found = []
    for photo in PHOTOS:
        color = photo[0, 0, :3].astype(float)
        likely = [level for level in (1.0, 0.35) if (np.abs(picture - level * color).max(-1) < 1.6).sum() > 500]
        found.append(likely[0] if likely else 0.0)
    return found


def test_photos_light_up_as_features_are_found(app: App, tmp_path: Path) -> None:
    file = tmp_path / "window.png"
    reading = replace(SEARCH, stage=COPYING, done=4, photos=4, thumbnails=PHOTOS[:4])
    assert shows(app, file, status="loading", loading="reading", posing=reading) == [0.35] * 4 + [0] * 2
    assert shows(app, file, status="loading", loading="features", posing=SEARCH) == [1] * 3 + [0.35] * 3
    matching = replace(SEARCH, stage=STAGES["matches"], done=0, total=15)
    assert shows(app, file, status="loading", loading="pairs", posing=matching) == [1] * 6


def fails(app: App, words: str) -> None:
    """Let the worker refuse to open what the user asks for."""
    assert isinstance(app.link, scripted.ScriptedWorker)
    app.perform(OpenScene(Path("holiday"), RunSettings()))
    app.link.waiting_notices.append(Notice("error", words, kind="failed", command=len(app.link.sent)))


def test_photos_stay_where_no_poses_are_found_with_the_reason(app: App, tmp_path: Path, texts: list[str]) -> None:
    file = tmp_path / "window.png"
    matching = replace(SEARCH, stage=STAGES["matches"], done=15, total=15)
    shows(app, file, status="loading", loading="pairs", posing=matching)
    fails(app, "holiday: no poses were found")
    assert shows(app, file, status="empty") == [1] * 6
    assert "holiday: no poses were found" in texts
    assert "no poses were found: nothing is open" in texts
    assert shows(app, file, status="loading", loading="photos: 1 of 9") == [0] * 6
    texts.clear()
    fails(app, "party: it has no photos")  # another capture, with poses
    assert shows(app, file, status="empty") == [0] * 6
    assert "no poses were found: nothing is open" not in texts
    assert "party: it has no photos" in texts


def test_a_search_that_is_cancelled_or_succeeds_is_not_said_to_fail(app: App, tmp_path: Path, texts: list[str]) -> None:
    file = tmp_path / "window.png"
    shows(app, file, status="loading", loading="pairs", posing=SEARCH)
    assert shows(app, file, status="empty") == [0] * 6  # cancelled: the worker does not fail
    placed = replace(SEARCH, stage=PLACED, done=6)
    shows(app, file, status="loading", loading="preparing the method", posing=placed)
    fails(app, "holiday: the photos are too large")
    assert shows(app, file, status="empty") == [0] * 6
    assert "no poses were found: nothing is open" not in texts


def test_damaged_photos_leave_no_gaps(app: App, tmp_path: Path) -> None:
    many = replace(SEARCH, done=50, total=100, photos=100)  # six thumbnails could be made
    assert (
        shows(app, tmp_path / "window.png", status="loading", loading="features", posing=many) == [1] * 3 + [0.35] * 3
    )


@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.8])
@pytest.mark.parametrize("room", [(900.0, 450.0), (200.0, 700.0)])
@pytest.mark.parametrize("count", [1, 2, 7, 120])
def test_photos_lie_side_by_side_within_the_space(count: int, room: tuple[float, float], aspect: float) -> None:
    boxes = places(count, aspect, room, 3.0)
    size = boxes[:, 2:] - boxes[:, :2]
    np.testing.assert_allclose(size[:, 0] / size[:, 1], aspect)
    assert (boxes > 0).all()
    assert (boxes[:, 2:] < room).all()
    apart = np.maximum(boxes[:, None, :2] - boxes[:, 2:], boxes[:, :2] - boxes[:, None, 2:]).max(-1)
    assert (apart + 1e3 * np.eye(count) > 2.9).all()


@pytest.mark.parametrize("total", [0, 1, 50, 120, 121, 1000])
def test_thumbnails_are_spread_evenly(total: int) -> None:
    chosen = thumbnails_of(total)
    assert min(total, 60) <= len(chosen) <= MOST_SHOWN
    assert list(chosen)[:1] == [0][:total]
