"""The window and its command with names that are not UTF-8 or that would break a line."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from odd_names import ODD, SHOWN, assert_printable, needs_bytes, write_capture

from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.live.messages import LoadCheckpoint, SaveCheckpoint
from nerf_core.training import checkpoint
from nerf_core.training.autosaves import spare_files
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.cli import main
from viewer.model.state import GoToView, SaveScreenshot, StartFilmExport
from viewer.session.script import Script
from viewer.session.session import Session
from viewer.session.wishes import Wishes
from viewer.ui.widgets import exists
from viewer.window import Window

TINY = [
    "--method", "nerf", "--device", "cpu", "--threads", "1", "--set", "rays=16", "--set", "coarse_samples=8",
    "--set", "fine_samples=8", "--set", "depth=2", "--set", "width=16", "--size", "640x400", "--headless",
]  # fmt: skip

pytestmark = needs_bytes


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("captures"))


def says(*arguments: str, status: int = 0) -> str:
    """Run the command and return what it printed, which must be printable. An error is one line."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        ended = main(arguments)
    said = out.getvalue() + err.getvalue()
    assert ended == status, said
    assert_printable(said)
    assert err.getvalue().count("\n") == (status != 0), said
    return said


@pytest.mark.thorough(6)
def test_everything_is_written_and_opened_again(capture: Path, tmp_path: Path) -> None:
    suffixes = (".png", ".npy", ".json", ".mp4", ".safetensors")
    files = [tmp_path / ODD / f"{ODD}{suffix}" for suffix in suffixes]
    picture, still, ray, film, model = files
    said = says(
        *TINY, str(capture), "--steps", "2", "--click", "0.5", "0.5", "--camera", f"images/1{ODD}.png",
        "--screenshot", str(picture), "--render", str(still), "--inspect", str(ray), "--orbit", str(film),
        "--save", str(model),
    )  # fmt: skip
    for file in files:
        assert file.is_file()
        assert f"wrote {str(file).replace(ODD, SHOWN)}" in said
    assert json.loads(ray.read_text("utf-8"))["scene"] == SHOWN
    assert checkpoint.describe(model)["scene_name"] == SHOWN
    loaded = ("--headless", "--size", "640x400", "--device", "cpu", "--load", str(model))
    again = says(*loaded, str(capture), "--screenshot", str(picture))
    assert f"wrote {str(picture).replace(ODD, SHOWN)}" in again


def test_what_is_missing_is_named(capture: Path, tmp_path: Path) -> None:
    nowhere = str(tmp_path / f"no {ODD}")
    for words in (
        ["--headless", nowhere],
        ["--load", nowhere],
        ["--headless", str(capture), "--camera", ODD, "--screenshot", str(tmp_path / "a.png")],
        ["--screenshot", nowhere],
        ["--mode", ODD],
        [f"--{ODD}"],
    ):
        says(*words, status=2)


@pytest.fixture
def session(window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / ODD))
    tiny = {"rays": "16", "coarse_samples": "8", "fine_samples": "8", "depth": "2", "width": "16"}
    with Signals() as signals:
        session = Session(window, RunSettings(method="nerf", device="cpu", threads=1, changes=tiny), signals, say)
        yield session
        session.close()


def test_a_window_shows_and_opens_it(session: Session, capture: Path, tmp_path: Path) -> None:
    app, state = session.app, session.app.state
    script = Script(app, session.worker, Wishes(), lambda: False, say)  # raises the error of any panel
    script.open(capture, session.settings)
    script.prepare()  # draws until the panels are docked, however few frames the loading took
    app.perform(GoToView(1))
    script._click("0.5", "0.5")
    script._train(2, None)
    model, film, picture = (tmp_path / ODD / f"{ODD}{suffix}" for suffix in (".safetensors", ".mp4", ".png"))
    script._ask(SaveCheckpoint(model), "saved")
    script._ask(LoadCheckpoint(model), "loaded")
    app.perform(SaveScreenshot(picture))
    app.settle()
    state.film.frames, state.film.width, state.film.height = 2, 32, 32
    script._export(StartFilmExport(film), "film")
    assert all(file.is_file() for file in (model, film, picture))
    for panel in app._host.panels:
        state.raise_panel = panel.title
        app.settle()
    state.raise_panel = "Notices"
    app.settle()
    said = [shown.notice for shown in state.notices]
    assert [notice.text for notice in said if notice.level == "error"] == []
    for notice in said:
        assert_printable(notice.text)
        assert "\n" not in notice.text
    assert f"exported {film}".replace(ODD, SHOWN) in [notice.text for notice in said]

    app.injector.click(*middle(app, f"notices.{len(said) - 1}.copy"))
    assert session.window.clipboard() == str(film).replace(ODD, SHOWN)
    state.raise_panel, state.open_path = "Scene", str(capture).replace(ODD, SHOWN)
    app.settle()
    opened = state.snapshot.loaded
    app.injector.click(*middle(app, "scene.open_paused"))
    script._wait(lambda s: s.loaded > opened)
    assert state.snapshot.scene is not None
    assert state.snapshot.scene.name == SHOWN


def test_a_path_exists_as_it_is_shown(capture: Path) -> None:
    """The copied path of an odd capture exists, although no file has just this name."""
    assert exists(capture)
    assert exists(Path(str(capture).replace(ODD, SHOWN)))
    assert not exists(Path("~nobody-of-this-name"))


def middle(app: App, mark: str) -> tuple[float, float]:
    left, top, right, bottom = app.widgets[mark]
    return (left + right) / 2, (top + bottom) / 2


def test_an_autosave_has_an_ordinary_name(capture: Path) -> None:
    for file in spare_files(load_scene(capture, LoadOptions())):
        assert file.name.startswith("caf-xe9-xff")
        assert file.name.isascii()
