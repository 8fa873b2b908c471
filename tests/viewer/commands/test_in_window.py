"""Commands in the whole window: menus, help and palette, driven by injected input."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import scripted
from imgui_bundle import imgui

from nerf_core.live.messages import Inspect, Train
from viewer.app.app import App
from viewer.commands import actions
from viewer.commands.registry import MENUS, USER_COMMANDS, commands
from viewer.panels import palette
from viewer.window import Window

Offscreen = Callable[..., Window]


def open_app(offscreen: Offscreen, size: tuple[int, int] = (1000, 700)) -> tuple[App, scripted.ScriptedWorker]:
    worker = scripted.ScriptedWorker(scripted.make_scene())
    app = App(offscreen(size), worker)
    app.settle(4)
    return app, worker


@pytest.fixture
def opened(offscreen: Offscreen) -> Iterator[tuple[App, scripted.ScriptedWorker]]:
    app, worker = open_app(offscreen)
    yield app, worker
    app.close()


def click(app: App, widget: str) -> None:
    left, top, right, bottom = app.widgets[widget]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle()


def open_palette(app: App) -> None:
    app.injector.key(imgui.Key.p, ctrl=True)
    app.settle()
    assert app.state.show_palette
    assert imgui.get_io().want_text_input


def test_menus_list_their_commands(opened: tuple[App, scripted.ScriptedWorker]) -> None:
    app, _ = opened
    for menu, x in zip(MENUS, (20, 60, 105), strict=True):
        app.injector.click(x, 10)
        app.settle()
        expected = {f"menu.{command.title}" for command in commands() if command.menu == menu}
        assert expected
        assert {name for name in app.widgets if name.startswith("menu.")} == expected
        app.injector.key(imgui.Key.escape)


def test_quit_and_reset_the_layout_from_the_menus(opened: tuple[App, scripted.ScriptedWorker]) -> None:
    app, _ = opened
    app.injector.click(20, 10)
    app.settle()
    assert not app.window.should_close()
    click(app, "menu.Quit")
    assert app.window.should_close()
    assert not app.state.quit


def test_the_palette_runs_what_is_typed_and_chosen(
    opened: tuple[App, scripted.ScriptedWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    app, worker = opened
    open_palette(app)
    app.injector.type_text("train")
    app.injector.key(imgui.Key.enter)
    app.settle()
    assert worker.sent == [Train()]
    assert not app.state.show_palette
    open_palette(app)
    app.injector.type_text("show or hide")
    app.injector.key(imgui.Key.down_arrow)
    run: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(palette, "invoke", lambda command, _: run.append(command.id) or [])
        app.injector.key(imgui.Key.enter)
        app.settle()
    assert run == [palette.matching("show or hide")[1].id]
    open_palette(app)  # it opens empty
    assert "palette.file.open" in app.widgets
    click(app, "palette.picture.view-dependence")
    assert (app.state.mode, app.state.show_palette) == ("view-dependence", False)


def test_keys_typed_into_the_palette_run_no_commands(opened: tuple[App, scripted.ScriptedWorker]) -> None:
    app, worker = opened
    app.injector.key(imgui.Key.p, ctrl=True)
    for key in (imgui.Key.space, imgui.Key.h, imgui.Key.period, imgui.Key._2):
        app.injector.key(key)
    app.injector.type_text("no such")
    app.injector.key(imgui.Key.enter)  # nothing matches
    app.settle()
    assert (worker.sent, app.state.show_help, app.state.mode, app.state.show_palette) == ([], False, "colour", True)


def test_escape_and_a_click_elsewhere_close_only_the_palette(opened: tuple[App, scripted.ScriptedWorker]) -> None:
    app, worker = opened
    left, top, right, bottom = app.widgets["viewport"]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    ray = app.state.inspect
    assert ray is not None
    open_palette(app)
    app.injector.key(imgui.Key.escape)
    app.settle()
    assert (app.state.show_palette, app.state.inspect) == (False, ray)
    open_palette(app)
    app.injector.click(left + 5, bottom - 5)
    app.settle()
    assert (app.state.show_palette, app.state.inspect) == (False, ray)
    assert [type(command) for command in worker.sent] == [Inspect]


def test_a_disabled_command_leaves_the_palette_open(offscreen: Offscreen) -> None:
    worker = scripted.ScriptedWorker(None)
    app = App(offscreen((1000, 700)), worker)
    app.settle(4)
    open_palette(app)
    app.injector.type_text("save checkpoint")
    app.injector.key(imgui.Key.enter)
    app.settle()
    assert (worker.sent, app.state.show_palette) == ([], True)
    assert imgui.get_io().want_text_input  # the user can go on typing
    app.close()


@pytest.mark.parametrize("size", [(60, 40), (320, 200), (640, 480), (2600, 300)])
def test_help_and_palette_lie_within_every_window(offscreen: Offscreen, size: tuple[int, int]) -> None:
    app, _ = open_app(offscreen, size)
    app.injector.key(imgui.Key.h)
    app.settle()
    open_palette(app)
    app.injector.type_text("f")
    app.settle()
    assert not app.state.notices
    drawn = {name: place for name, place in app.widgets.items() if name.startswith(("palette.", "help."))}
    for name, (left, _, right, _) in drawn.items():
        assert (left >= 0, right <= size[0]) == (True, True), name
    assert drawn or size == (60, 40)
    app.close()


NEW = """
from viewer.commands.registry import command

@command("extra.level", "Level the horizon", "Camera", 9, keys=("Ctrl+L",), menu="View")
def level(state):
    state.rays_file = "level"
    return []

@command("extra.fails", "Fail at once", "Camera", 10, keys=("Ctrl+Y",), menu="View")
def fails(state):
    return [1 / 0]
"""


@pytest.fixture
def new_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Add a file with commands to those of the folder."""
    USER_COMMANDS.names()
    (tmp_path / "extra.py").write_text(NEW, encoding="utf-8")
    monkeypatch.setattr(actions, "__path__", [*actions.__path__, str(tmp_path)])
    monkeypatch.setattr(USER_COMMANDS, "_items", dict(USER_COMMANDS._items))
    monkeypatch.setattr(USER_COMMANDS, "_complete", False)
    yield
    del sys.modules["viewer.commands.actions.extra"]


def ask_for(app: App, how: str, key: imgui.Key, title: str) -> None:
    if how == "key":
        app.injector.key(key, ctrl=True)
    elif how == "menu":
        app.injector.click(60, 10)
        app.settle()
        click(app, f"menu.{title}")
    else:
        open_palette(app)
        app.injector.type_text(title)
        app.injector.key(imgui.Key.enter)
        app.settle()


@pytest.mark.usefixtures("new_file")
@pytest.mark.parametrize("how", ["key", "menu", "palette"])
def test_a_command_is_one_new_file(offscreen: Offscreen, how: str) -> None:
    app, _ = open_app(offscreen)
    ask_for(app, how, imgui.Key.l, "Level the horizon")
    assert app.state.rays_file == "level"
    assert not app.state.notices
    app.close()


@pytest.mark.usefixtures("new_file")
@pytest.mark.parametrize("how", ["key", "menu", "palette"])
def test_a_command_that_fails_becomes_a_notice(offscreen: Offscreen, how: str) -> None:
    app, worker = open_app(offscreen)
    ask_for(app, how, imgui.Key.y, "Fail at once")
    (shown,) = app.state.notices
    assert shown.notice.text == (
        "the command Fail at once failed (ZeroDivisionError: division by zero); the rest goes on"
    )
    assert "in fails" in shown.notice.detail
    assert not app.state.show_palette
    app.injector.key(imgui.Key.space)
    assert worker.sent == [Train()]
    app.close()
