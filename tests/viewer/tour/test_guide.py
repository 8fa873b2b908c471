"""A tour in the window: its deeds reach the app and the worker, and it notices what the reader does."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import platformdirs
import pytest
import scripted
from imgui_bundle import imgui

from nerf_core.lab.records import StudyState
from nerf_core.live.messages import CancelStudy, InOrder, Inspect, OpenScene, Pause, SaveUnsaved, Train
from nerf_core.rendering.export.requests import Export
from viewer.app.app import App
from viewer.model.state import TourWish
from viewer.tour.guide import shipped
from viewer.tour.steps import read_tour
from viewer.window import Window

STEPS = {
    "1-look": """# Look
Text with **strong** words.
@orbit 40 20
@mode view-dependence
@cameras on
@panel Training
@train
@equation step {step}, w = {w}
@try Move.
@until moved
@question Why?
@answer Because.""",
    "2-ray": """# A ray
@photo 2
@samples off
@mode colour
@open 0 0 0.3
@pause
Text.
@equation {samples} samples, σ = {sigma}
@try Open one.
@until opened near 0 0 0 1
@try Go on.
@until training""",
    "3-rest": """# Rest
Text.
@try Export.
@until exported
@try Drag a sample.
@until hand
@try Go to Evidence.
@until panel Evidence""",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in STEPS.items():
        (tmp_path / f"{name}.md").write_text(text, "utf-8")
    return tmp_path


@pytest.fixture
def start(offscreen: Callable[..., Window], tmp_path: Path) -> Iterator[Callable[..., App]]:
    apps: list[App] = []

    def begin(folder: Path | None, **options: object) -> App:
        worker = scripted.ScriptedWorker(scripted.make_scene())
        worker.stride = 8
        app = App(offscreen((1000, 640)), worker, **options)  # pyright: ignore[reportArgumentType]
        apps.append(app)
        app.settle(2)
        app.state.tour = TourWish("begin", folder)
        until(app, lambda: bool(app.tour.steps))
        return app

    yield begin
    for app in apps:
        app.close()


def until(app: App, holds: Callable[[], bool]) -> None:
    """Draw frames until something holds."""
    end = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < end, app.tour.error
        time.sleep(0.005)  # for the thread that reads
        app.settle(1)


def shown(app: App) -> None:
    """Draw frames until the step has done its deeds and the camera rests."""
    until(app, lambda: not app.tour.busy and not app.state.camera.flying)
    app.settle(3)


def sent(app: App, kind: type) -> list[object]:
    assert isinstance(app.link, scripted.ScriptedWorker)
    return [command for command in app.link.sent if isinstance(command, kind)]


def click(app: App, widget: str) -> None:
    left, top, right, bottom = app.widgets[widget]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle(2)


def test_a_tour_from_its_first_page_to_its_last(start: Callable[..., App], folder: Path) -> None:
    app = start(folder)
    shown(app)
    state, guide = app.state, app.tour
    assert (state.mode, state.show_cameras) == ("view-dependence", True)
    assert "Training" in state.in_front
    assert len(sent(app, Train)) == 1
    back = state.camera.c2w()[:, 2]  # 40° from the x axis, 20° up
    np.testing.assert_allclose(np.degrees([np.arctan2(back[1], back[0]), np.arcsin(back[2])]), [40, 20], atol=1e-6)
    assert not guide.ticks  # the tour's own flight is none of the reader's

    left, top, right, bottom = app.widgets["viewport"]
    app.injector.drag(((left + right) / 2, (top + bottom) / 2), ((left + right) / 2 + 60, (top + bottom) / 2))
    app.settle(3)
    assert guide.ticks == {("1-look", 0)}
    click(app, "tour.answer")
    assert "tour.answer" not in app.widgets

    click(app, "tour.next")
    shown(app)
    assert guide.at == 1
    assert state.current_view == 2
    assert len(sent(app, Pause)) == 1
    (ray,) = sent(app, Inspect)
    assert isinstance(ray, Inspect)
    assert ray.pixel == (ray.camera.width // 2, ray.camera.height // 2)  # photos look at the point that is opened
    assert guide.ticks == {("1-look", 0)}  # the ray that the tour opened is none of the reader's
    left, top, right, bottom = app.widgets["viewport"]
    app.injector.click((left + right) / 2 + 3, (top + bottom) / 2)
    click(app, "bar.train")
    until(app, lambda: {("2-ray", 0), ("2-ray", 1)} <= guide.ticks)

    app.injector.key(imgui.Key.page_down)
    shown(app)
    assert guide.at == 2
    worker = app.link
    assert isinstance(worker, scripted.ScriptedWorker)
    worker.current = replace(worker.current, export=Export(Path("orbit.mp4"), 4, 4, 0.0, "done"))
    state.hand_changes += 1
    state.raise_panel = "Evidence"
    until(app, lambda: {("3-rest", n) for n in range(3)} <= guide.ticks)
    app.injector.key(imgui.Key.page_up)
    app.settle(2)
    assert guide.at == 1
    click(app, "tour.leave")
    assert not guide.on
    assert "tour.next" not in app.widgets
    assert not state.show_left_off  # nothing of the reader's was put aside


def test_the_place_and_the_ticks_are_remembered(start: Callable[..., App], folder: Path, tmp_path: Path) -> None:
    layout = tmp_path / "settings" / "layout.ini"
    app = start(folder, layout_file=layout)
    shown(app)
    app.tour.go(2)
    shown(app)
    app.state.hand_changes += 1
    until(app, lambda: bool(app.tour.ticks))
    stored = json.loads(layout.with_name("tour.json").read_text("utf-8"))
    assert stored == {str(folder): {"step": "3-rest", "ticks": [["3-rest", 1]]}}
    app.close()
    again = start(folder, layout_file=layout)
    assert (again.tour.at, again.tour.ticks) == (2, {("3-rest", 1)})
    again.close()
    layout.with_name("tour.json").write_text('{"x": 3, "y": [')  # half a file is no reason not to begin
    assert start(folder, layout_file=layout).tour.at == 0


def test_a_tour_saves_the_readers_own_model_before_it_opens_its_own(start: Callable[..., App], tmp_path: Path) -> None:
    (tmp_path / "1.md").write_text("# A\nText.\n@scene demo\n@method voxels prune_every=40\n@train")
    (tmp_path / "2.md").write_text("# B\nText.\n@mode view-dependence")
    app = start(tmp_path)
    until(app, lambda: bool(sent(app, InOrder)))
    (both,) = sent(app, InOrder)
    assert isinstance(both, InOrder)
    save, opening = both.commands
    assert isinstance(save, SaveUnsaved)
    assert isinstance(opening, OpenScene)
    assert (opening.path, opening.options.method, opening.options.changes) == (None, "voxels", {"prune_every": "40"})
    worker = app.link
    assert isinstance(worker, scripted.ScriptedWorker)
    assert not sent(app, Train)  # it waits for the model
    worker.current = replace(worker.current, loaded=2, method="voxels")
    shown(app)
    app.tour.go(1)  # a step without @method keeps the model
    shown(app)
    assert len(sent(app, InOrder)) == 1
    assert not sent(app, OpenScene)
    app.tour.leave(app.state)
    assert app.state.show_left_off


def test_leaving_offers_what_an_earlier_tour_put_aside_and_stops_its_study(
    start: Callable[..., App], tmp_path: Path
) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, text in ((one, "# A\nText.\n@scene demo\n@method voxels"), (other, "# B\nText.\n@study image")):
        folder.mkdir()
        (folder / "1.md").write_text(text)
    app = start(one)
    until(app, lambda: bool(sent(app, InOrder)))
    app.state.tour = TourWish("begin", other)
    until(app, lambda: app.tour.step is not None and app.tour.step.title == "B")
    worker = app.link
    assert isinstance(worker, scripted.ScriptedWorker)
    running = StudyState("image", platformdirs.user_cache_path("nerf-viewer") / "tour" / "image-1")
    worker.current = replace(worker.current, study=running)
    app.settle(2)
    assert not sent(app, CancelStudy)  # it is this step's
    app.tour.leave(app.state)
    app.settle(2)
    assert app.state.show_left_off
    assert len(sent(app, CancelStudy)) == 1


def test_a_language_that_is_chosen_while_the_steps_are_read_counts(start: Callable[..., App]) -> None:
    app = start(None)
    app.tour.steps = ()  # as while they are read
    app.state.tour = TourWish("begin")
    app.state.language = "ru"
    until(app, lambda: app.tour.step is not None and app.tour.step.title == "Фотографии и камеры")


def test_a_presenter_sees_the_panels_of_the_step_alone_in_large_type(start: Callable[..., App], folder: Path) -> None:
    app = start(folder)
    shown(app)
    em, everything = app.theme.em, set(app.state.in_front)
    app.injector.key(imgui.Key.f5)
    app.settle(4)
    assert app.theme.em == round(1.4 * em)
    assert app.state.in_front == ("Training",)
    assert len(everything) > 3
    app.injector.key(imgui.Key.f5)
    app.settle(6)
    assert app.theme.em == em
    assert set(app.state.in_front) == everything


def test_a_folder_that_is_no_tour_is_said_in_the_bar(offscreen: Callable[..., Window], tmp_path: Path) -> None:
    app = App(offscreen((900, 600)), scripted.ScriptedWorker(scripted.make_scene()))
    app.state.tour = TourWish("begin", tmp_path)
    until(app, lambda: bool(app.tour.error))
    assert "holds no step" in app.tour.error
    click(app, "tour.leave")
    assert not app.tour.on
    app.close()


def test_the_programs_own_tour_is_the_same_in_every_language() -> None:
    folders = sorted(folder for folder in shipped().parent.iterdir() if folder.is_dir())
    assert {folder.name for folder in folders} >= {"en", "ru"}
    first, *others = (read_tour(folder) for folder in folders)
    for tour in others:
        for one, other in zip(first, tour, strict=True):
            assert one.name == other.name
            assert one.panels == other.panels
            assert [type(block) for block in one.blocks] == [type(block) for block in other.blocks]


def test_several_questions_of_a_step_are_answered_one_by_one(start: Callable[..., App], tmp_path: Path) -> None:
    (tmp_path / "1.md").write_text(
        "# A\nText.\n@question B?\n@answer C.\n@question D?\n@answer E.\n@question F?\n@answer G."
    )
    app = start(tmp_path)
    shown(app)
    click(app, "tour.answer")  # the last one has the mark
    assert app.tour.answered == {("1", 3)}
    click(app, "tour.answer")
    assert app.tour.answered == {("1", 2), ("1", 3)}


def test_an_equation_is_broken_in_the_narrowest_bar() -> None:
    from viewer.tour.side_bar import broken

    text = "α_i = 1 − exp(−σ_i δ_i) = 1 − exp(−3.6 · 0.137) = 0.379"
    for letters in range(-3, 60):
        assert "".join("".join(broken(text, letters)).split()) == "".join(text.split())
