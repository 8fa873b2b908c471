"""The window offers to continue where one left off, says what autosaves take, and deletes them if asked to."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scripted
import torch
from imgui_bundle import imgui

from nerf_core.datasets import LoadOptions
from nerf_core.live.messages import InOrder, Inspect, Notice, OpenScene, SaveUnsaved, Snapshot
from nerf_core.training import autosaves, checkpoint
from nerf_core.training.autosaves import left_off, small_picture
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.commands.registry import run
from viewer.window import Window

Write = Callable[..., Path]
LOAD = LoadOptions(format="blender", downscale=4)
DESCRIPTION: dict[str, Any] = {
    "method": "voxels", "config": {}, "steps": 0, "seed": 0, "threads": 1, "step": 1234, "seconds": 61.5,
    "scene": "0123abcd" * 8, "scene_name": "chair", "scene_summary": "",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path / "data" / "nerf-viewer" / "autosave"


@pytest.fixture
def write(folder: Path, tmp_path: Path) -> Write:
    """A function that writes autosaves, each an hour older than the one before."""
    written: list[Path] = []

    def write_one(capture: Path = tmp_path, picture: torch.Tensor | None = None) -> Path:
        file = folder / f"chair-0123abcd-20260102-030405-{len(written)}.safetensors"
        gray = np.full((9, 16, 4), 2 * len(written), np.uint8)
        tensors = small_picture(file, gray) if picture is None else {"picture": picture}
        checkpoint.save(file, DESCRIPTION | left_off(file, capture, LOAD), {"weights": torch.zeros(1000), **tensors})
        os.utime(file, (1e9 - 3600 * len(written), 1e9 - 3600 * len(written)))
        written.append(file)
        return file

    return write_one


@pytest.fixture(params=[(1.0, (1280, 800)), (2.0, (1280, 800))], ids=["scale 1", "scale 2"])
def app(request: pytest.FixtureRequest, offscreen: Callable[..., Window]) -> Iterator[App]:
    """A window without a scene, at two scales."""
    scale, size = request.param
    app = App(offscreen(size, scale), scripted.ScriptedWorker())
    app.state.settings = RunSettings(method="nerf", device="cpu")
    yield app
    app.close()


def offer(app: App) -> None:
    """Show the offer, and wait until the files are read."""
    run("file.left_off", app.state)
    wait(app, lambda: app.state.left_off.entries is not None)


def wait(app: App, done: Callable[[], bool]) -> None:
    limit = time.monotonic() + 20
    while not done():
        assert time.monotonic() < limit
        app.frame(force=True)
    app.settle()


def click(app: App, name: str) -> None:
    left, top, right, bottom = app.widgets[name]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle()


def sent(app: App) -> list[OpenScene]:
    assert isinstance(app.link, scripted.ScriptedWorker)
    return [command for command in app.link.sent if isinstance(command, OpenScene)]


def set_snapshot(app: App, **changes: Any) -> None:
    assert isinstance(app.link, scripted.ScriptedWorker)
    app.link.current = replace(Snapshot(), **changes)
    app.settle()


def test_a_click_opens_the_scene_with_its_model_paused(app: App, write: Write, tmp_path: Path) -> None:
    write()
    file = write()
    offer(app)
    click(app, "left_off.1")
    (command,) = sent(app)
    assert command == OpenScene(tmp_path, RunSettings(load=LOAD, device="cpu"), train=False, checkpoint=file)


def test_the_offer_shows_pictures_and_leaves_when_a_scene_is_open(app: App, write: Write) -> None:
    file = write()
    offer(app)
    wait(app, lambda: str(file) in app.state.left_off.pictures)
    left, top, _, bottom = map(round, app.widgets["left_off.0"])
    assert app.pixels()[(top + bottom) // 2, left + round(3 * app.theme.em)].tolist() == [0, 0, 0]  # of the first
    set_snapshot(app, status="loading", loading="loading photos")
    assert "left_off.0" not in app.widgets
    set_snapshot(app)  # it failed
    assert "left_off.0" in app.widgets
    set_snapshot(app, status="paused", scene=scripted.make_scene(), loaded=1)
    assert "left_off.close" not in app.widgets


def test_a_capture_that_has_gone_cannot_be_clicked(app: App, write: Write, tmp_path: Path) -> None:
    write(tmp_path / "gone")
    offer(app)
    click(app, "left_off.0")
    assert not sent(app)
    assert [one.problem for one in app.state.left_off.entries or ()] == [f"{tmp_path / 'gone'} is no longer there"]
    assert not app.state.notices


@pytest.mark.parametrize("picture", [torch.zeros(3), torch.zeros(0, 0, 3).byte(), torch.zeros(9, 9, 4).byte()])
def test_a_damaged_picture_does_not_break_the_start(app: App, write: Write, picture: torch.Tensor) -> None:
    write(picture=picture)
    write()
    offer(app)
    wait(app, lambda: len(app.state.left_off.pictures) == 1)
    assert not app.state.notices
    click(app, "left_off.0")
    assert len(sent(app)) == 1


def test_clearing_asks_once_and_deletes_what_is_listed(app: App, write: Write, folder: Path) -> None:
    files = [write(), write()]
    (folder / "mine.safetensors").write_bytes(files[0].read_bytes())
    offer(app)
    click(app, "left_off.clear")
    assert all(file.exists() for file in files)
    click(app, "left_off.clear_keep")
    click(app, "left_off.clear")
    click(app, "left_off.clear_confirm")
    wait(app, lambda: app.state.left_off.entries == () and bool(app.state.notices))
    assert [path.name for path in folder.iterdir()] == ["mine.safetensors"]
    assert "deleted 2 autosaves" in app.state.notices[-1].notice.text
    assert "left_off.demo" in app.widgets
    click(app, "left_off.demo")
    assert sent(app) == [OpenScene(None, app.state.settings, train=True)]


def test_unsaved_steps_are_not_forgotten_unasked(app: App, write: Write) -> None:
    write()
    set_snapshot(app, status="paused", scene=scripted.make_scene(), loaded=1, step=5)
    offer(app)
    assert "left_off.demo" not in app.widgets  # there is a scene
    click(app, "left_off.0")
    assert not sent(app)
    click(app, "left_off_keep")
    assert not sent(app)
    click(app, "left_off.0")
    click(app, "left_off_confirm")
    (opened,) = sent(app)
    assert isinstance(opened, OpenScene)
    offer(app)
    click(app, "left_off.0")
    click(app, "left_off_save")
    assert isinstance(app.link, scripted.ScriptedWorker)
    both = app.link.sent[-1]
    assert isinstance(both, InOrder)
    saved, then = both.commands
    assert isinstance(saved, SaveUnsaved)
    assert then == opened


@pytest.mark.parametrize("asked", [False, True], ids=["at once", "after a save"])
def test_the_next_scene_is_opened_like_the_autosave_if_that_opened(
    app: App, write: Write, tmp_path: Path, asked: bool
) -> None:
    """But for the format, which was that capture's alone. A failure changes nothing."""
    write()
    before = app.state.settings
    if asked:
        set_snapshot(app, status="paused", scene=scripted.make_scene(), loaded=1, step=5)
    for answer in (Notice("error", "gone", kind="failed"), Notice("info", "loaded", kind="loaded")):
        offer(app)
        click(app, "left_off.0")
        if asked:
            click(app, "left_off_save")
        assert app.state.settings == before
        assert isinstance(app.link, scripted.ScriptedWorker)
        app.link.waiting_notices.append(replace(answer, command=len(app.link.sent)))
        app.settle()
        after = app.state.settings
        if answer.kind == "failed":
            assert after == before
    assert after == replace(before, load=replace(LOAD, format="auto"))
    assert app.state.open_path == str(tmp_path)


def test_a_list_in_a_folder_that_is_not_utf8_can_be_drawn(
    app: App, write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "caf\udce9"))
    file = tmp_path / "caf\udce9" / "nerf-viewer" / "autosave" / "chair-0123abcd-20260102-030405-7.safetensors"
    gray = small_picture(file, np.full((9, 16, 4), 7, np.uint8))
    odd = DESCRIPTION | {"method": "gr\u202e"} | left_off(file, tmp_path, LOAD)
    checkpoint.save(file, odd, {"weights": torch.zeros(9), **gray})
    offer(app)
    wait(app, lambda: len(app.state.left_off.pictures) == 1)
    assert [one.method for one in app.state.left_off.entries or ()] == ["gr\\u202e"]
    assert not app.state.notices
    click(app, "left_off.0")
    assert [command.checkpoint for command in sent(app)] == [file]


def test_escape_closes_the_question_then_the_list_and_not_the_ray(app: App, write: Write) -> None:
    write()
    set_snapshot(app, status="paused", scene=scripted.make_scene(), loaded=1, step=5)
    ray = app.state.inspect = Inspect(app.state.camera.camera(64, 48), (5, 5))
    offer(app)
    click(app, "left_off.clear")
    for shown in (True, False):
        app.injector.key(imgui.Key.escape)
        app.settle()
        assert "left_off.clear_confirm" not in app.widgets
        assert ("left_off.0" in app.widgets, app.state.show_left_off) == (shown, shown)
        assert app.state.inspect is ray
    app.injector.key(imgui.Key.escape)
    assert app.state.inspect is None


def test_clearing_offers_no_saving(app: App, write: Write) -> None:
    write()
    offer(app)
    click(app, "left_off.clear")
    assert "left_off.clear_confirm" in app.widgets
    assert "left_off.clear_save" not in app.widgets


def test_the_window_waits_for_no_disk(app: App, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(30):
        write()
    disk, real = threading.Event(), autosaves.autosaves
    monkeypatch.setattr(autosaves, "autosaves", lambda: (disk.wait(20), real())[1])
    run("file.left_off", app.state)
    begin = time.monotonic()
    app.settle(5)
    assert time.monotonic() - begin < 10
    assert app.state.left_off.entries is None
    assert "left_off.open" in app.widgets
    disk.set()
    wait(app, lambda: len(app.state.left_off.pictures) == 30)
    assert "left_off.0" in app.widgets
    assert "left_off.29" not in app.widgets  # it is scrolled away


def test_without_autosaves_the_offer_says_so(app: App, folder: Path) -> None:
    offer(app)
    assert "left_off.clear" not in app.widgets
    click(app, "left_off.close")
    assert "left_off.open" not in app.widgets


def test_another_folder_can_be_opened_instead(app: App, write: Write) -> None:
    write()
    offer(app)
    click(app, "left_off.open")
    assert "left_off.open" not in app.widgets
    assert "scene.path" in app.widgets
