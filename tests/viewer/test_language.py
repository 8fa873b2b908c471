"""The language of the window: it is chosen in a menu, remembered, and changes nothing else."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scripted
from imgui_bundle import imgui
from shown_texts import Brackets, outside, recorded

from nerf_core.common import language
from nerf_core.common.language import ENGLISH, use_language
from nerf_core.live.messages import Snapshot
from viewer.app.app import App
from viewer.ui.layout import VIEWPORT
from viewer.window import Window

Offscreen = Callable[..., Window]
Open = Callable[..., App]


@pytest.fixture
def in_brackets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What "ru" is while a test runs."""
    real = language._catalogue
    monkeypatch.setattr(language, "_catalogue", lambda code: real(code) if code == ENGLISH else Brackets())
    yield
    use_language(ENGLISH)


@pytest.fixture
def opened(offscreen: Offscreen, in_brackets: None) -> Iterator[Open]:
    """A function that opens apps, one at a time. Those that a failed test leaves open are closed."""
    apps: list[App] = []

    def open_app(file: Path | None = None, code: str = "") -> App:
        clock = itertools.count(100.0, 0.5)
        worker = scripted.ScriptedWorker(scripted.make_scene())
        window = offscreen((1000, 700))
        apps.append(App(window, worker, layout_file=file, language=code, time=lambda: next(clock)))
        apps[-1].settle()
        return apps[-1]

    yield open_app
    for app in apps:
        app.close()


def click(app: App, name: str) -> None:
    left, top, right, bottom = app.widgets[name]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle()


def texts(app: App) -> set[str]:
    """What one frame shows."""
    with recorded() as shown:
        app.frame(force=True)
    return shown.texts


def test_a_language_is_chosen_in_the_view_menu_and_remembered(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    assert {"View", "Scene"} <= texts(app)
    docked = {title: imgui.internal.find_window_by_name(title).dock_id for title in (VIEWPORT, "Scene", "Export")}
    app.injector.click(60, 10)
    app.settle()
    click(app, "submenu.Language")
    click(app, "menu.Русский")
    assert {"⟦View⟧", "⟦Scene⟧"} <= texts(app)
    assert not {"View", "Scene"} & texts(app)
    app.state.raise_panel = "Export"  # panels are still called by their English titles
    app.settle(5)
    assert "Export" in app._host.in_front
    app.close()
    assert language.language() == ENGLISH  # of what is printed when the window is gone

    again = opened(file)
    assert again.state.language == "ru"
    assert "⟦View⟧" in texts(again)
    assert {title: imgui.internal.find_window_by_name(title).dock_id for title in docked} == docked
    again.close()

    once = opened(file, ENGLISH)  # as --language does
    assert "View" in texts(once)
    once.close()
    assert "\n; language: ru\n" in file.read_text("utf-8")


def test_no_untranslated_text_in_the_viewport(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    app = opened(code="ru")
    full = app.link.snapshot()
    assert full.preview is not None
    app.state.camera.orbit(5.0, 5.0, 400)
    preview = replace(full.preview, complete=True, camera=app.state.camera.camera(*app.state.viewport))
    unseen = replace(preview, depth=np.full_like(preview.depth, np.nan))
    shaded = replace(preview, mode="view-dependence")
    states = {
        "Nothing is open": Snapshot(loaded=full.loaded),
        "Opening": Snapshot(status="loading", loaded=full.loaded),
        "No picture: the worker failed": Snapshot(status="failed", loaded=full.loaded),
        "photo {name}: the first picture is on its way": replace(full, preview=None),
        "Nothing is seen from here. {command}": replace(full, preview=unseen, method="nerf"),
        "View-dependence": replace(full, preview=shaded),
    }
    for text, snapshot in states.items():
        monkeypatch.setattr(app.link, "snapshot", lambda snapshot=snapshot: snapshot)
        app.settle(2)
        found = texts(app)
        assert any(text.partition("{")[0] in one for one in found), (text, found)
        assert not [one for one in found if outside(one)]
