"""A session and its script without their command line."""

from __future__ import annotations

import os
import shlex
import signal
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
import scripted
import textured_photos

from nerf_core.common.errors import UserError
from nerf_core.common.signals import Signals
from nerf_core.datasets.capture import DATASETS, LoadOptions
from nerf_core.live.messages import Command, Inspect, Notice, Snapshot, Train
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.cli import main
from viewer.session.script import Script
from viewer.session.session import Session
from viewer.session.wishes import Wishes
from viewer.window import Window


def test_the_window_shows_which_plugins_cannot_be_loaded(
    offscreen: Callable[..., Window], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(METHODS, "problems", ["the method nope cannot be loaded"])
    monkeypatch.setattr(DATASETS, "problems", ["the dataset never cannot be loaded"])
    with Signals() as signals:
        session = Session(offscreen((320, 200)), RunSettings(), signals, print)
        try:
            session.app.run(lambda: len(session.app.state.notices) > 1)
            notices = [shown.notice for shown in session.app.state.notices]
        finally:
            session.close()
    assert [(one.level, one.text) for one in notices] == [
        ("warning", "the method nope cannot be loaded"),
        ("warning", "the dataset never cannot be loaded"),
    ]


@pytest.mark.parametrize(
    ("wishes", "trains"),
    [(Wishes(), True), (Wishes(load=Path("x")), False), (Wishes(load=Path("x"), seconds=5.0), True)],
)
def test_a_checkpoint_that_is_only_looked_at_stays_as_it_is(
    offscreen: Callable[..., Window], wishes: Wishes, trains: bool
) -> None:
    with Signals() as signals:
        session = Session(offscreen((320, 200)), RunSettings(), signals, print)
        try:
            signals.received = signal.SIGTERM  # so that the window closes at once
            sent: list[Command] = []
            session.worker.send = lambda command: sent.append(command) or 0
            session._attend(wishes)
            assert [type(command) for command in sent] == ([Train] if trains else [])
        finally:
            del session.worker.send
            session.close()


class Refusing(scripted.ScriptedWorker):
    """A worker that answers each request for a ray with an error, at once."""

    alive = True

    def send(self, command: Command) -> int:
        if not isinstance(command, Inspect):
            return super().send(command)
        self.waiting_notices.append(Notice("error", "no ray is opened"))
        return 0


@pytest.fixture
def script(offscreen: Callable[..., Window]) -> Iterator[Script]:
    """A script that gives up soon, with `Closed`, if it waits in vain."""
    worker, turns = Refusing(scripted.make_scene()), count()
    app = App(offscreen((900, 600)), worker)
    app.settle()
    yield Script(app, worker, Wishes(), lambda: next(turns) > 20, print)  # pyright: ignore[reportArgumentType]: scripted
    app.close()


def test_a_click_outside_the_viewport_is_refused_before_training(script: Script) -> None:
    script.wishes = Wishes(clicks=(("0.5", "0.5"), ("5000", "5")))
    with pytest.raises(UserError, match=r"--click 5000: outside the viewport, which is .* pixels wide here"):
        script.prepare()


def test_an_error_in_the_frames_of_a_click_ends_the_script(script: Script) -> None:
    with pytest.raises(UserError, match="no ray is opened"):
        script._click("0.5", "0.5")


def test_an_error_before_a_film_is_begun_ends_the_script(script: Script) -> None:
    script.app.state.film.fps = 0.0
    with pytest.raises(UserError, match="a film of 0 frames per second"):
        script._film(Path("film.mp4"), None)


def stopped(window: Window, photos: Path, settings: RunSettings, until: Callable[[Snapshot], bool]) -> list[str]:
    """Open photos without poses and train, send SIGINT as soon as `until`, and return what the session says."""
    said: list[str] = []
    with Signals() as signals:
        session = Session(window, settings, signals, said.append)
        real = session.app.frame

        def frame(force: bool = False) -> bool:
            drawn = real(force)
            if signals.received is None and until(session.app.state.snapshot):
                os.kill(os.getpid(), signal.SIGINT)
            return drawn

        session.app.frame = frame
        try:
            assert session.run(photos, Wishes(steps=100_000)) == 128 + signal.SIGINT
        finally:
            session.close()
    return said


def test_what_is_said_after_a_signal_continues_the_training(
    offscreen: Callable[..., Window], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole command is said: the capture with its options, quoted, and the file."""
    for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    photos = textured_photos.write(tmp_path / "my photos", textured_photos.arc())
    load = LoadOptions(poses="fast", downscale=4)
    settings = RunSettings(load, method="voxels", device="cpu", threads=1)
    *_, last = stopped(offscreen((320, 200)), photos, settings, lambda s: s.step > 2)
    before, words, command = last.partition("; continue with ")
    assert words, last
    file = before.removeprefix("saved to ")
    name, *arguments = shlex.split(command)
    options = ["--downscale", "4", "--poses", "fast", "--device", "cpu"]
    assert (name, arguments) == ("nerf-viewer", [str(photos), *options, "--load", file])
    picture = tmp_path / "picture.npy"
    assert main([*arguments, "--headless", "--size", "320x200", "--render", str(picture)]) == 0
    assert picture.is_file()


def test_a_stopped_search_for_poses_is_told(
    offscreen: Callable[..., Window],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    photos = textured_photos.write(tmp_path / "photos", textured_photos.arc())
    stopped(offscreen((320, 200)), photos, RunSettings(device="cpu", threads=1), lambda s: s.posing is not None)
    assert capsys.readouterr().err == "nerf-viewer: the search for poses was stopped: nothing of it is kept\n"
    assert not list((tmp_path / "cache").rglob("poses.json"))
