"""The worked examples of docs/extending.md that belong to the window."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pages
import pytest
import scripted
from imgui_bundle import imgui

from viewer.app.app import App
from viewer.commands.registry import USER_COMMANDS
from viewer.ui.contract import PANELS
from viewer.window import Window

Start = Callable[[], App]
SCENE = scripted.make_scene()
TRAIN = SCENE.split("train")


@pytest.fixture
def start(offscreen: Callable[..., Window]) -> Iterator[Start]:
    apps: list[App] = []

    def open_app() -> App:
        apps.append(App(offscreen((840, 620)), scripted.ScriptedWorker(SCENE)))
        apps[-1].settle(6)
        return apps[-1]

    yield open_app
    for app in apps:
        app.close()


def test_a_panel(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    load = pages.loader(monkeypatch)
    load("viewer/panels/nearest_photo.py", PANELS)
    app = start()
    app.state.raise_panel = "Nearest photo"
    app.settle(6)
    eye = app.state.camera.c2w()[:, 3]
    left, top, right, bottom = app.widgets["nearest_photo.go"]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle(6)
    gone = app.state.current_view
    distances = {i: np.linalg.norm(SCENE.views[i].camera.c2w[:, 3] - eye) for i in TRAIN}
    assert gone is not None
    assert distances[gone] == min(distances.values())


def test_a_command_with_a_key(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    load = pages.loader(monkeypatch)
    load("viewer/commands/actions/first_photo.py", USER_COMMANDS)
    app = start()
    app.injector.key(imgui.Key.home)
    app.settle(6)
    assert app.state.current_view == TRAIN[0]
