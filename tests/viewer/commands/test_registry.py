"""The rules for every command, and the places that list commands."""

from __future__ import annotations

from pathlib import Path

import pytest
from imgui_bundle import imgui
from panel_states import make_snapshot, make_state

from nerf_core.live.messages import Pause, SaveCheckpoint, Train
from nerf_core.rendering.modes import mode_names
from viewer.commands import actions
from viewer.commands.keyboard import FLY, Chord
from viewer.commands.overview import overview
from viewer.commands.registry import USER_COMMANDS, UserCommand, commands, run, with_keys
from viewer.model.state import AppState, GoToView, SaveScreenshot, StartFilmExport

ROOT = Path(actions.__file__).parents[3]


@pytest.mark.parametrize("command", commands(), ids=lambda command: command.id)
def test_a_command_runs_where_it_is_enabled(command: UserCommand) -> None:
    assert command.title
    assert command.title[0].isupper()
    for state in (AppState(), make_state(make_snapshot())):
        if command.enabled(state):
            assert isinstance(command.run(state), list)
        if command.checked is not None:
            before = command.checked(state)
            command.run(state)
            assert command.checked(state) == (not before)


def test_no_two_commands_share_a_chord_or_a_title() -> None:
    chords = [Chord.parse(keys) for command in commands() for keys in command.keys]
    flying = [Chord.parse(name) for pair in FLY for name in pair]
    assert len({*chords, *flying}) == len(chords) + len(flying)
    titles = [command.title for command in commands()]
    assert len(set(titles)) == len(titles)


@pytest.mark.parametrize(
    ("text", "key", "ctrl"),
    [
        ("F", imgui.Key.f, False),
        ("Ctrl+S", imgui.Key.s, True),
        ("1", imgui.Key._1, False),
        ("F11", imgui.Key.f11, False),
        ("Space", imgui.Key.space, False),
        ("→", imgui.Key.right_arrow, False),
        ("Ctrl+.", imgui.Key.period, True),
    ],
)
def test_chords(text: str, key: imgui.Key, ctrl: bool) -> None:
    assert Chord.parse(text) == Chord(key, ctrl)


@pytest.mark.parametrize("text", ["", "Ctrl+", "Hyper+S", "ß", "F99", "count"])
def test_a_chord_that_does_not_exist_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match="no key is called"):
        Chord.parse(text)


def test_commands_that_need_a_scene_do_nothing_without_one() -> None:
    for name in ("file.save", "file.export", "training.toggle", "training.step", "camera.frame", "camera.next"):
        assert run(name, AppState()) == []
    state = make_state(make_snapshot())
    assert [type(action) for action in run("file.save", state)] == [SaveCheckpoint]
    assert run("file.export", state) == [StartFilmExport()]
    assert (state.show_panels, state.raise_panel) == (True, "Export")
    assert run("file.screenshot", AppState()) == [SaveScreenshot(Path("screenshot.png"))]


def test_training_starts_and_pauses_with_the_same_command() -> None:
    assert run("training.toggle", make_state(make_snapshot(status="training"))) == [Pause()]
    assert run("training.toggle", make_state(make_snapshot(status="paused"))) == [Train()]


def test_next_and_previous_photo_wrap_around() -> None:
    state = make_state(make_snapshot())
    assert state.snapshot.scene is not None
    train = state.snapshot.scene.split("train")
    assert run("camera.next", state) == [GoToView(train[0])]
    assert run("camera.previous", state) == [GoToView(train[-1])]
    state.current_view = train[-1]
    assert run("camera.next", state) == [GoToView(train[0])]


def test_every_render_mode_has_a_number_key() -> None:
    for number, mode in enumerate(mode_names(), 1):
        state = AppState()
        assert USER_COMMANDS.get(f"picture.{mode}").keys == ((str(number),) if number < 10 else ())
        run(f"picture.{mode}", state)
        assert state.mode == mode


def test_tooltips_end_in_the_keys() -> None:
    assert with_keys("see all", "camera.frame") == "see all (F)"
    assert with_keys("end", "window.quit") == "end"


# ---- lists of commands ----------------------------------------------------------------------------------------------


def test_the_documented_table_of_keys_matches_the_registry() -> None:
    """If this fails, put the printed table between <!-- keys --> and <!-- /keys -->."""
    files = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    texts = [file.read_text(encoding="utf-8") for file in files]
    (text,) = [text for text in texts if "<!-- keys -->" in text]
    found = text.partition("<!-- keys -->")[2].partition("<!-- /keys -->")[0].strip()
    lines = ["| | action | mouse or key |", "|---|---|---|"]
    for section, rows in overview():
        lines += [f"| {section if k == 0 else ''} | {what} | {how} |" for k, (what, how) in enumerate(rows)]
    expected = "\n".join(line.replace("|  |", "| |") for line in lines)
    print(expected)
    assert found == expected
