"""A window that is started for nothing in particular offers to continue where one left off."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from desk import PATIENCE

from nerf_core.training import autosaves
from viewer.app.app import App
from viewer.cli import main
from viewer.model.state import AppState

TINY = ["--method", "voxels", "--device", "cpu", "--threads", "1", "--downscale", "8"]


@pytest.fixture
def home(display: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a user who has no autosaves yet, with a display."""
    (tmp_path / "t").mkdir()
    own = {"DISPLAY": display, "WAYLAND_DISPLAY": "", "XDG_CONFIG_HOME": str(tmp_path / "c")}
    for name, value in (own | {"XDG_DATA_HOME": str(tmp_path), "TMPDIR": str(tmp_path / "t")}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t"))
    return tmp_path


def leave(steps: int) -> Path:
    """Train the demo scene in a window for some steps, and end it. Returns the autosave."""
    code = f"""
from viewer.app.app import App
import os, signal
ready = lambda s: s.step >= {steps} and s.preview is not None and s.preview.step > 0
real = App.run
def run(self, until):
    ended = lambda: ready(self.state.snapshot) and not os.kill(os.getpid(), signal.SIGTERM)
    real(self, lambda: until() or ended())
App.run = run
from viewer.cli import command
command()
"""
    command = [sys.executable, "-c", code, *TINY, "--size", "640x480"]
    done = subprocess.run(command, env=os.environ, timeout=PATIENCE, check=False, capture_output=True, text=True)
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    (one,) = autosaves.autosaves()
    return one.file


def turn(app: App, state: AppState, name: str) -> None:
    """Draw frames until a widget is shown."""
    limit = time.monotonic() + PATIENCE
    while name not in app.widgets:
        assert time.monotonic() < limit, (name, state.notices)
        app.window.poll(0.02)
        app.frame(force=True)


@pytest.mark.thorough(6)
def test_one_click_continues_where_one_left_off(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = leave(5)
    (one,) = autosaves.autosaves()
    assert (one.scene, one.capture, one.problem) == ("demo", None, "")
    picture = autosaves.picture(file)
    assert picture is not None
    assert picture.shape[1] <= autosaves.PICTURE_SIDE
    assert picture[..., :3].std() > 5  # it shows something
    steps: list[int] = []

    def look(app: App, _: object) -> None:
        state = app.state
        assert state.snapshot.scene is None
        turn(app, state, "left_off.0")
        limit = time.monotonic() + PATIENCE
        place, still = app.widgets["left_off.0"], 0
        while still < 5 and time.monotonic() < limit:  # it moves until the layout and the small picture are there
            app.window.poll(0.02)
            app.frame(force=True)
            place, still = app.widgets["left_off.0"], still + 1 if app.widgets["left_off.0"] == place else 0
        left, top, right, bottom = place
        app.injector.click((left + right) / 2, (top + bottom) / 2)
        while state.snapshot.scene is None and time.monotonic() < limit:
            app.window.poll(0.02)
            app.frame(force=True)
        steps.extend((state.snapshot.step, state.snapshot.saved_step))
        assert (state.snapshot.method, state.snapshot.status) == ("voxels", "paused")

    monkeypatch.setattr(App, "run", look)
    assert main([]) == 0
    assert steps == [one.step, one.step]
    assert [left.file for left in autosaves.autosaves()] == [file]  # nothing was trained, so nothing is saved


def test_the_demo_scene_opens_if_there_is_nothing_to_continue(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def look(app: App, _: object) -> None:
        assert not app.state.show_left_off
        assert app.state.snapshot.scene is not None
        seen.append(app.state.snapshot.scene.name)

    monkeypatch.setattr(App, "run", look)
    assert main(TINY) == 0
    folder = home / "nerf-viewer" / "autosave"
    folder.mkdir(parents=True)
    (folder / "chair-0123abcd-20260102-030405-1.safetensors").write_bytes(b"of another program")
    assert main([*TINY[:-2], "--downscale", "9"]) == 0
    assert seen == ["demo", "demo"]
