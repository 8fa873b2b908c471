"""The worked examples of docs/extending.md that belong to the window."""

from __future__ import annotations

from collections.abc import Callable

import pages
import pytest
import scripted

from viewer.app.app import App
from viewer.ui.contract import PANELS
from viewer.window import Window


def test_a_panel(offscreen: Callable[..., Window], monkeypatch: pytest.MonkeyPatch) -> None:
    load = pages.loader(monkeypatch)
    load("viewer/panels/compass.py", PANELS)
    scene = scripted.make_scene()
    worker = scripted.ScriptedWorker(scene)
    app = App(offscreen((840, 620)), worker)
    app.settle(6)
    app.state.raise_panel = "Compass"
    app.settle(6)
    left, top, right, bottom = app.widgets["compass.first"]
    app.hand.click((left + right) / 2, (top + bottom) / 2)
    app.settle(6)
    assert app.state.current_view == scene.split("train")[0]
    app.close()
