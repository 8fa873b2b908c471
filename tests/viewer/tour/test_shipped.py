"""The program's own tour, from its first page to its last: its models, and each task done as a reader does it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import scripted
import tour_reader

from nerf_core.live.messages import (
    Command,
    InOrder,
    LoadCheckpoint,
    Notice,
    OpenScene,
    SaveCheckpoint,
    SaveUnsaved,
    StartStudy,
    Train,
    UseMethod,
)
from nerf_core.rendering.export.requests import Export
from viewer.app.app import App
from viewer.model.state import TourWish
from viewer.tour.steps import Task
from viewer.window import Window

SIZE = (900, 560)


class Obedient(scripted.ScriptedWorker):
    """A worker that also opens and keeps models, without training them. done: every command, also those in order."""

    def __init__(self) -> None:
        super().__init__(replace(scripted.make_scene(), format="demo"))
        self.current = replace(self.current, saved_step=self.current.step)
        self.stride, self.done, self._files = 8, list[Command](), dict[Path, str]()

    def send(self, command: Command) -> int:
        number = super().send(command)
        for one in command.commands if isinstance(command, InOrder) else (command,):
            self.done.append(one)  # pyright: ignore[reportArgumentType]
            match one:
                case UseMethod(method):
                    self._open(method, number, step=0)
                case OpenScene(_, options):
                    self.current = replace(self.current, loaded=self.current.loaded + 1)
                    self._open(options.method, number, step=0)
                case LoadCheckpoint(path):
                    self._open(self._files[path], number, step=7)
                case SaveCheckpoint(path):
                    self._files[path] = self.current.method
                    self.current = replace(self.current, saved_step=self.current.step)
                case _:
                    pass
        return number

    def _open(self, method: str, number: int, step: int) -> None:
        self.current = replace(self.current, method=method, step=step, saved_step=step, status="training")
        self.waiting_notices.append(Notice("info", "opened", kind="loaded", command=number))

    def write_film(self) -> None:
        self.current = replace(self.current, export=Export(Path("orbit.mp4"), 4, 4, 0.0, "done"))


class Clock:
    """A clock that moves on by a tenth of a second whenever it is read: flights are over in two frames."""

    now = 1000.0

    def __call__(self) -> float:
        self.now += 0.1
        return self.now


@pytest.fixture
def begun(offscreen: Callable[..., Window]) -> Iterator[tuple[App, Obedient]]:
    worker = Obedient()
    app = App(offscreen(SIZE), worker, time=Clock())
    app.settle(2)
    app.state.tour = TourWish("begin")
    end = time.monotonic() + 60
    while not app.tour.steps:
        assert time.monotonic() < end, app.tour.error
        time.sleep(0.01)
        app.settle(1)
    yield app, worker
    app.close()


def rest(app: App) -> None:
    """Draw frames until the step has done its deeds and the camera stands still."""
    for _ in range(60):
        app.settle(1)
        if not app.tour.busy and not app.state.camera.flying:
            return app.settle(2)
    raise AssertionError(app.tour.step)


def do(app: App, worker: Obedient, task: Task) -> None:
    """Do what a task asks for, and wait until the camera stands still."""
    tour_reader.do(app, task, app.settle)
    if task.until is not None and task.until.words == "exported":
        worker.write_film()
    rest(app)


def test_a_reader_goes_through_all_of_it(begun: tuple[App, Obedient]) -> None:
    app, worker = begun
    guide, steps = app.tour, app.tour.steps
    for k, step in enumerate(steps):
        rest(app)
        assert guide.step is step
        assert worker.current.scene is not None
        if step.page or step.panels:
            assert (step.page or step.panels[-1]) in app.state.in_front, step.name
        for number, task in enumerate(step.tasks):
            if task.until is None:
                continue
            for _ in range(2):  # a key of training may have to be pressed twice
                if (step.name, number) not in guide.ticks:
                    do(app, worker, task)
            assert (step.name, number) in guide.ticks, (step.name, task.until.words)
        if k + 1 < len(steps):
            left, top, right, bottom = app.widgets["tour.next"]
            app.injector.click((left + right) / 2, (top + bottom) / 2)
    assert not [s.notice.text for s in app.state.notices if s.notice.level == "error"]
    methods = [one.name for one in worker.done if isinstance(one, UseMethod)]
    assert len(methods) == len(set(methods)) >= 2
    assert {one.name for one in worker.done if isinstance(one, StartStudy)} == {"image", "flatland"}
    assert not any(isinstance(one, SaveUnsaved) for one in worker.done)  # nothing was the reader's
    app.tour.leave(app.state)
    assert app.state.settings.method == "auto"  # what the reader opens next is not the tour's affair


def test_going_back_goes_on_with_the_model_that_was_there(begun: tuple[App, Obedient]) -> None:
    app, worker = begun
    rest(app)
    first = worker.current.method
    other = next(k for k, step in enumerate(app.tour.steps) if k and any(deed.method for deed in step.deeds))
    worker.current = replace(worker.current, step=7)  # it has learnt something
    app.tour.go(other)
    rest(app)
    (saved,) = (one for one in worker.done if isinstance(one, SaveCheckpoint))
    assert worker.current.method != first
    app.tour.go(0)
    rest(app)
    assert worker.done.index(LoadCheckpoint(saved.path)) < worker.done.index(Train())
    assert (worker.current.method, worker.current.step) == (first, 7)


def test_another_language_keeps_the_place(begun: tuple[App, Obedient]) -> None:
    app, worker = begun
    rest(app)
    app.tour.go(1)
    rest(app)
    english, sent = app.tour.steps[1].title, len(worker.sent)
    app.state.language = "ru"
    app.settle(3)
    assert app.tour.at == 1
    assert app.tour.steps[1].title != english
    assert len(worker.sent) == sent  # and nothing is done again


def test_a_refused_model_does_not_stop_the_tour(begun: tuple[App, Obedient]) -> None:
    app, worker = begun
    rest(app)
    before = len(worker.done)
    worker._open = lambda *_, **__: worker.waiting_notices.append(Notice("error", "no memory", kind="failed"))
    other = next(k for k, step in enumerate(app.tour.steps) if k and any(deed.method for deed in step.deeds))
    app.tour.go(other)
    rest(app)
    app.settle(5)
    assert sum(isinstance(one, UseMethod) for one in worker.done[before:]) == 1
    assert app.tour.step is app.tour.steps[other]
