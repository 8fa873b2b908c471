"""The whole window, driven by injected input, against a worker that answers in closed form."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import scripted
from imgui_bundle import imgui, implot
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.photos import Photos
from nerf_core.live.messages import (
    CancelExport,
    InOrder,
    Inspect,
    Notice,
    OpenScene,
    Pause,
    PinRay,
    Reset,
    SaveCheckpoint,
    SaveUnsaved,
    Snapshot,
    StartExport,
    StopInspecting,
    Train,
    UseMethod,
)
from nerf_core.probe import Verdict
from nerf_core.rendering.export.requests import ExportModel, ExportPath
from nerf_core.training.settings import RunSettings
from viewer.app import viewport_panel
from viewer.app.app import App
from viewer.commands.perform import film_export
from viewer.draw.photo import nearest_photo
from viewer.model.state import (
    Action,
    AppState,
    FilmForm,
    GoToView,
    SaveScreenshot,
    SetPointDepth,
)
from viewer.ui.contract import PANELS, Ui
from viewer.window import Window

Start = Callable[..., tuple[App, scripted.ScriptedWorker]]
Offscreen = Callable[..., Window]


SIZE = (840, 620)


class Clock:
    """A clock that moves on by one frame of 60 Hz whenever it is read."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        self.now += 1 / 60
        return self.now


@pytest.fixture
def start(offscreen: Offscreen) -> Iterator[Start]:
    apps: list[App] = []

    def open_app(
        size: tuple[int, int] = SIZE, *, scene: bool = True, **options: object
    ) -> tuple[App, scripted.ScriptedWorker]:
        worker = scripted.ScriptedWorker(scripted.make_scene() if scene else None)
        app = App(offscreen(size), worker, time=Clock(), **options)  # pyright: ignore[reportArgumentType]
        apps.append(app)
        app.settle(4)
        return app, worker

    yield open_app
    for app in apps:
        app.close()


def middle(app: App) -> tuple[float, float]:
    left, top, right, bottom = app.widgets["viewport"]
    return float((left + right) // 2), float((top + bottom) // 2)


def rest(app: App) -> None:
    """Draw frames until the camera no longer counts as moving."""
    app.settle(15)


# ---- the picture ----------------------------------------------------------------------------------------------------


def test_the_preview_is_shown_pixel_for_pixel(start: Start) -> None:
    app, worker = start()
    app.state.show_samples = False
    rest(app)
    preview = worker.current.preview
    assert preview is not None
    left, top, right, bottom = (int(v) for v in app.widgets["viewport"])
    assert (preview.camera.width, preview.camera.height) == (right - left, bottom - top) == app.state.viewport
    np.testing.assert_array_equal(app.pixels()[top:bottom, left:right], preview.rgba[..., :3])
    assert not app.stale


def test_a_drag_orbits_and_warps_until_the_worker_answers(start: Start) -> None:
    app, worker = start()
    rest(app)
    worker.answering = False
    before = app.state.camera.c2w()
    x, y = middle(app)
    app.injector.drag((x, y), (x + 80, y + 10))
    assert not np.allclose(app.state.camera.c2w(), before)
    assert app.stale
    assert not worker.sent  # a drag is never a click
    worker.answering = True
    rest(app)
    assert not app.stale


def test_views_are_requested_while_moving_and_once_more_at_rest(start: Start) -> None:
    app, worker = start()
    rest(app)
    count = len(worker.views)
    rest(app)
    assert len(worker.views) == count  # nothing changed, so nothing is requested
    x, y = middle(app)
    app.injector.drag((x, y), (x + 40, y))
    rest(app)
    asked = worker.views[count:]
    assert [view.moving for view in asked][-2:] == [True, False]
    assert all(view.moving for view in asked[:-1])
    stamps = [view.stamp for view in worker.views]
    assert stamps == sorted(set(stamps))
    assert (asked[-1].camera.width, asked[-1].camera.height) == app.state.viewport


@pytest.mark.parametrize(("button", "shift"), [(1, False), (0, True), (2, False)])
def test_other_drags_pan(start: Start, button: int, shift: bool) -> None:
    app, _ = start()
    x, y = middle(app)
    rotation = app.state.camera.c2w()[:, :3]
    eye = app.state.camera.c2w()[:, 3]
    app.injector.drag((x, y), (x + 50, y), button, shift=shift)
    np.testing.assert_allclose(app.state.camera.c2w()[:, :3], rotation)
    assert np.linalg.norm(app.state.camera.c2w()[:, 3] - eye) > 0.01


def test_the_wheel_zooms_over_the_viewport_only(start: Start) -> None:
    app, _ = start()
    distance = app.state.camera.distance
    x, y = middle(app)
    app.injector.wheel(x, y, 2)
    app.settle()
    assert app.state.camera.distance < distance
    distance = app.state.camera.distance
    app.injector.wheel(SIZE[0] - 20, 400, 2)  # over a panel
    app.settle()
    assert app.state.camera.distance == distance


# ---- clicks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("slip", "clicks"), [(0, 1), (4, 1), (5, 0)])
def test_a_click_is_a_press_and_release_within_4_pixels(start: Start, slip: int, clicks: int) -> None:
    app, worker = start()
    x, y = middle(app)
    app.injector.drag((x, y), (x + slip, y), steps=1)
    asked = [command for command in worker.sent if isinstance(command, Inspect)]
    assert len(asked) == clicks
    if asked:
        left, top, _, _ = app.widgets["viewport"]
        assert asked[0].pixel == (int(x - left), int(y - top))  # where it was pressed
        np.testing.assert_array_equal(asked[0].camera.c2w, app.state.camera.c2w())
        assert app.state.inspect is asked[0]


def test_a_slip_and_return_is_a_drag(start: Start) -> None:
    app, worker = start()
    x, y = middle(app)
    app.injector.move(x, y)
    app.injector.press()
    app.injector.move(x + 30, y)
    app.injector.move(x, y)
    app.injector.release()
    app.settle()
    assert not worker.sent


def test_the_ray_is_drawn_where_it_was_clicked(start: Start) -> None:
    app, _ = start()
    rest(app)
    plain = app.pixels()
    x, y = middle(app)
    app.injector.click(x, y)
    app.injector.move(2, 2)
    changed = (
        np.abs(app.pixels().astype(int) - plain).max(-1)[int(y) - 30 : int(y) + 30, int(x) - 30 : int(x) + 30] > 30
    )
    rows, columns = np.nonzero(changed)
    assert len(rows) > 20
    np.testing.assert_allclose([rows.mean() - 30, columns.mean() - 30], 0, atol=3)
    app.state.show_samples = False
    app.settle()
    np.testing.assert_array_equal(
        app.pixels()[int(y) - 30 : int(y) + 30, int(x)], plain[int(y) - 30 : int(y) + 30, int(x)]
    )


def test_a_double_click_focuses_the_surface_under_it(start: Start) -> None:
    app, worker = start()
    rest(app)
    left, top, _, _ = app.widgets["viewport"]
    x, y = middle(app)
    x -= 30
    preview = worker.current.preview
    assert preview is not None
    camera = preview.camera
    directions, _ = scripted.rays(camera, np.array([x - left]), np.array([y - top]))
    distance, _ = scripted.trace(camera.c2w[:, 3], directions)
    app.injector.double_click(x, y)
    app.settle(30)  # the jump eases
    expected = camera.c2w[:, 3] + distance[0] * directions[:, 0]
    np.testing.assert_allclose(app.state.camera.pivot, expected, atol=1e-4)
    assert sum(isinstance(command, Inspect) for command in worker.sent) == 1  # the second click opens no ray of its own


def test_dragging_the_depth_asks_for_the_same_ray_again(start: Start) -> None:
    app, worker = start()
    app.perform(SetPointDepth(2.0))
    assert not worker.sent  # no ray is open
    app.injector.click(*middle(app))
    first = app.state.inspect
    assert first is not None
    app.perform(SetPointDepth(2.0))
    second = worker.sent[-1]
    assert isinstance(second, Inspect)
    assert second == replace(first, point_t=2.0, look=second.look)
    assert second.look != first.look
    app.perform(SetPointDepth(None))
    third = worker.sent[-1]
    assert isinstance(third, Inspect)
    assert third == replace(first, look=third.look)


# ---- keys -----------------------------------------------------------------------------------------------------------


def test_space_trains_and_pauses_and_a_dot_makes_one_step(start: Start) -> None:
    app, worker = start()
    app.injector.key(imgui.Key.space)
    app.injector.key(imgui.Key.space)
    app.injector.key(imgui.Key.period)
    assert worker.sent == [Train(), Pause(), Train(1)]


def test_arrows_walk_through_the_training_photos_and_moving_leaves_them(start: Start) -> None:
    app, worker = start()
    scene = worker.current.scene
    assert scene is not None
    for expected in (0, 1, 2):
        app.injector.key(imgui.Key.right_arrow)
        assert app.state.current_view == expected
    app.injector.key(imgui.Key.left_arrow)
    app.settle(30)
    np.testing.assert_allclose(app.state.camera.c2w(), scene.views[1].camera.c2w, atol=1e-6)
    x, y = middle(app)
    app.injector.drag((x, y), (x + 30, y))
    assert app.state.current_view is None


def test_flying_moves_the_eye_while_a_key_is_held(start: Start) -> None:
    app, _ = start()
    forward = -app.state.camera.c2w()[:, 2]
    eye = app.state.camera.c2w()[:, 3]
    app.injector.hold(imgui.Key.w, 10)
    moved = app.state.camera.c2w()[:, 3] - eye
    np.testing.assert_allclose(moved / np.linalg.norm(moved), forward, atol=1e-6)


def test_tab_hides_all_but_the_viewport_and_brings_it_back(start: Start) -> None:
    app, _ = start()
    small = app.state.viewport
    app.injector.key(imgui.Key.tab)
    app.settle()
    assert app.state.viewport[0] == SIZE[0]
    app.injector.key(imgui.Key.tab)
    app.settle()
    assert app.state.viewport == small


def test_tab_leaves_the_tabs_as_they_were(start: Start) -> None:
    app, _ = start((1280, 800))
    for title in ("View", "Export"):
        app.state.raise_panel = title
        app.settle()
        front = app._host.in_front
        assert title in front
        app.injector.key(imgui.Key.tab)
        app.settle()
        app.injector.key(imgui.Key.tab)
        app.settle(5)
        assert app._host.in_front == front


@pytest.mark.parametrize("hidden", [False, True])
def test_ctrl_e_shows_where_the_export_can_be_watched(start: Start, hidden: bool) -> None:
    app, _ = start((1280, 800))
    app.state.film.file = "turn"
    assert "Export" not in app._host.in_front
    if hidden:
        app.injector.key(imgui.Key.tab)
    app.injector.key(imgui.Key.e, ctrl=True)
    app.settle(5)
    assert "Export" in app._host.in_front


def test_ctrl_o_finds_the_path_field_although_the_panels_are_hidden(start: Start) -> None:
    app, _ = start((1280, 800))
    app.injector.key(imgui.Key.tab)
    app.injector.key(imgui.Key.o, ctrl=True)
    app.settle(5)
    assert imgui.get_io().want_text_input
    app.injector.type_text("/data")
    assert app.state.open_path == "/data"


@pytest.mark.parametrize("name", [".", "/", "~nobody-of-this-name/x.mp4"])
def test_a_film_name_that_cannot_be_a_file_is_an_error(start: Start, name: str) -> None:
    app, worker = start()
    app.state.film.file = name
    app.injector.key(imgui.Key.e, ctrl=True)
    app.settle()
    assert not worker.sent
    assert [n.notice.level for n in app.state.notices] == ["error"]


@pytest.mark.parametrize("letter_first", [True, False])
def test_a_chord_that_is_over_before_the_next_frame_counts(start: Start, letter_first: bool) -> None:
    """Both keys go down and up between two frames, as from a script or on a slow machine."""
    app, worker = start()
    io, place = imgui.get_io(), app.state.camera.c2w().copy()
    up = [imgui.Key.s, imgui.Key.left_ctrl, imgui.Key.mod_ctrl]
    for key in (imgui.Key.left_ctrl, imgui.Key.mod_ctrl, imgui.Key.s):
        io.add_key_event(key, True)
    for key in up if letter_first else reversed(up):
        io.add_key_event(key, False)
    app.settle(6)
    assert [type(c) for c in worker.sent] == [SaveCheckpoint]
    np.testing.assert_array_equal(app.state.camera.c2w(), place)


def test_a_chord_counts_if_ctrl_is_pressed_a_frame_earlier_and_released_first(start: Start) -> None:
    app, worker = start()
    io, place = imgui.get_io(), app.state.camera.c2w().copy()
    for key in (imgui.Key.left_ctrl, imgui.Key.mod_ctrl):
        io.add_key_event(key, True)
    app.settle(1)
    io.add_key_event(imgui.Key.s, True)
    for key in (imgui.Key.mod_ctrl, imgui.Key.left_ctrl, imgui.Key.s):
        io.add_key_event(key, False)
    app.settle(6)
    assert [type(c) for c in worker.sent] == [SaveCheckpoint]
    np.testing.assert_array_equal(app.state.camera.c2w(), place)


def test_saving_without_a_name_takes_an_unused_one(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    app, worker = start()
    assert app.state.snapshot.scene is not None
    name = app.state.snapshot.scene.name
    Path(f"{name}.safetensors").touch()
    for _ in range(2):
        app.injector.key(imgui.Key.s, ctrl=True)
    assert worker.sent == [SaveCheckpoint(tmp_path / f"{name}-2.safetensors")] * 2  # the second overwrites the first
    assert app.state.checkpoint_file == f"{name}-2.safetensors"


def test_escape_closes_a_menu_before_the_ray(start: Start) -> None:
    app, worker = start()
    left, top, right, bottom = app.widgets["viewport"]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    assert app.state.inspect is not None
    app.injector.click(20, 10)  # the menu File
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)
    app.injector.key(imgui.Key.escape)
    assert not imgui.is_popup_open("", imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)
    assert app.state.inspect is not None
    app.injector.key(imgui.Key.escape)
    assert app.state.inspect is None
    assert isinstance(worker.sent[-1], StopInspecting)


def test_ctrl_s_and_ctrl_e_save_and_export(start: Start) -> None:
    app, worker = start()
    app.state.checkpoint_file = "kept.safetensors"
    app.state.film.frames, app.state.film.file = 5, "turn.mp4"
    app.injector.key(imgui.Key.s, ctrl=True)
    app.injector.key(imgui.Key.e, ctrl=True)
    save, export = worker.sent
    assert save == SaveCheckpoint(Path("kept.safetensors").absolute())  # so that what it answers names the folder
    assert isinstance(export, StartExport)
    film = export.request
    assert isinstance(film, ExportPath)
    assert (len(film.cameras), film.fps, film.file) == (5, 30.0, Path("turn.mp4").absolute())
    assert (film.cameras[0].width, film.cameras[0].height) == (40, 30)  # the training photos' size


def test_typing_into_a_text_field_runs_no_commands(start: Start) -> None:
    app, worker = start((1000, 1200))
    app.injector.key(imgui.Key.o, ctrl=True)  # gives the keyboard focus to the path's field
    app.settle()
    assert imgui.get_io().want_text_input
    eye = app.state.camera.c2w()
    app.injector.type_text("/data/w")
    app.injector.key(imgui.Key.space)
    app.injector.hold(imgui.Key.w, 3)
    assert app.state.open_path == "/data/w"
    assert not worker.sent
    np.testing.assert_array_equal(app.state.camera.c2w(), eye)
    app.injector.key(imgui.Key.enter)
    app.settle()
    asked = [command for command in worker.sent if isinstance(command, OpenScene)]
    confirmed = app.widgets.get("scene.open_confirm")  # opening a scene discards 100 steps, so the panel asks first
    assert asked or confirmed


@pytest.mark.parametrize("field", ["scene.path", "training.checkpoint", "export.file"])
def test_what_is_typed_right_after_a_click_goes_into_the_field(start: Start, field: str) -> None:
    app, worker = start((1000, 1200))
    if field == "export.file":
        app.state.raise_panel = "Export"
    app.settle()
    box, io, eye = app.widgets[field], imgui.get_io(), app.state.camera.c2w()
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    sent = len(worker.sent)
    io.add_mouse_pos_event(x, y)  # all of it waits when the next frame begins
    io.add_mouse_button_event(0, True)
    io.add_mouse_button_event(0, False)
    for letter in "was":
        key = getattr(imgui.Key, letter)
        io.add_key_event(key, True)
        io.add_input_character(ord(letter))
        io.add_key_event(key, False)
    for _ in range(20):
        app.frame(force=True)
    text = {
        "scene.path": app.state.open_path, "training.checkpoint": app.state.checkpoint_file,
        "export.file": app.state.film.file,
    }[field]  # fmt: skip
    assert "was" in text
    np.testing.assert_array_equal(app.state.camera.c2w(), eye)
    assert len(worker.sent) == sent


# ---- errors ---------------------------------------------------------------------------------------------------------


class Faulty:
    title = "Faulty"
    dock: Literal["right"] = "right"
    order = 0
    broken = True

    def draw(self, ui: Ui, state: AppState) -> list[Action]:
        imgui.begin_child("left open")
        imgui.push_style_color(imgui.Col_.text, ui.theme.error)
        implot.begin_plot("left open too")
        if self.broken:
            raise RuntimeError("no luck")
        implot.end_plot()
        imgui.pop_style_color()
        imgui.end_child()
        return []


class Sound:
    title = "Sound"
    dock: Literal["right"] = "right"
    order = 1
    drawn = 0

    def draw(self, ui: Ui, state: AppState) -> list[Action]:
        self.drawn += 1
        if implot.begin_plot("mine"):
            implot.end_plot()
        imgui.button("Cancel")
        ui.mark("sound.cancel")
        return [CancelExport()] if imgui.is_item_clicked() else []


def test_a_failing_panel_is_reported_once_and_the_others_go_on(start: Start) -> None:
    faulty, sound = Faulty(), Sound()
    app, worker = start(panels=[faulty, sound])
    drawn = sound.drawn
    app.settle(10)
    assert sound.drawn == drawn + 10
    told = [shown.notice for shown in app.state.notices]
    assert len(told) == 1
    assert told[0].level == "error"
    assert "the panel Faulty failed (RuntimeError: no luck)" in told[0].text
    assert "Traceback" in told[0].detail
    left, top, right, bottom = app.widgets["sound.cancel"]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    assert worker.sent == [CancelExport()]
    faulty.broken = False
    left, top, right, bottom = app.widgets["Faulty.retry"]
    app.injector.click((left + right) / 2, (top + bottom) / 2)
    app.settle()
    assert "Faulty.retry" not in app.widgets


def test_the_workers_notices_are_kept_with_their_time(start: Start) -> None:
    app, worker = start()
    worker.waiting_notices = [Notice("warning", "3 images are missing")]
    app.frame()
    assert app.state.notices[-1].notice.text == "3 images are missing"
    assert app.state.notices[-1].born == app.state.time


def test_an_impossible_orbit_is_a_notice(start: Start) -> None:
    app, worker = start()
    app.state.film.file = " "
    app.injector.key(imgui.Key.e, ctrl=True)
    assert not worker.sent
    assert app.state.notices[-1].notice == Notice("error", "the film has no file name: give one that ends in .mp4")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("options", {"radius": -1.0}, "radius of -1"),
        ("options", {"elevation": 100.0}, "elevation of 100"),
        ("fps", 0.0, "a film of 0 frames per second"),
        ("path", "loop", "unknown camera path 'loop'"),
    ],
)
def test_export_forms_are_checked(field: str, value: object, words: str) -> None:
    with pytest.raises(UserError, match=words):
        film_export(scripted.make_scene(), replace(FilmForm(), **{field: value}))


def test_the_file_of_a_model_may_begin_with_a_tilde(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    app, worker = start()
    monkeypatch.setenv("HOME", "/home/me")
    app.perform(StartExport(ExportModel(Path("~/model.ply"))))
    assert worker.sent == [StartExport(ExportModel(Path("/home/me/model.ply")))]
    app.perform(StartExport(ExportModel(Path("~nobody-at-all/model.ply"))))
    assert len(worker.sent) == 1
    assert "there is no such user's folder" in app.state.notices[-1].notice.text


def test_a_form_left_alone_takes_the_number_of_frames_of_the_path() -> None:
    scene = scripted.make_scene()
    held_out = len(scene.split("test"))
    for name in PATHS.names():
        film = film_export(scene, FilmForm(path=name))
        assert len(film.cameras) == (PATHS.get(name).default_frames or held_out)


def test_a_screenshot_that_cannot_be_written_is_a_notice(start: Start, tmp_path: Path) -> None:
    app, _ = start()
    app.perform(SaveScreenshot(tmp_path / "shot.png"))
    app.settle(1)
    with Image.open(tmp_path / "shot.png") as image:
        assert image.size == SIZE
    app.perform(SaveScreenshot(tmp_path / "shot.png" / "below.png"))
    app.settle(1)
    assert [shown.notice.level for shown in app.state.notices] == ["info", "error"]


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (60, 40), (320, 200), (2600, 300)])
def test_the_window_draws_at_any_size(start: Start, size: tuple[int, int]) -> None:
    app, _ = start()
    app.window.resize(*size)
    app.settle(4)
    assert app.frame(force=True) == (size != (0, 0))
    app.window.resize(900, 600)
    app.settle(4)
    assert app.state.viewport[0] > 100


@pytest.mark.parametrize("status", ["empty", "loading", "ready", "training", "paused", "finished", "failed"])
def test_every_state_draws_with_and_without_a_scene(start: Start, status: str) -> None:
    app, worker = start(scene=False)
    worker.current = replace(Snapshot(), status=status, loading="loading photos: 3 of 10")  # pyright: ignore[reportArgumentType]
    app.settle()
    worker.current = replace(scripted.ScriptedWorker(scripted.make_scene()).current, status=status)
    app.settle()
    assert not app.state.notices


def test_a_new_scene_closes_the_ray_and_moves_the_camera(start: Start) -> None:
    app, worker = start()
    home = app.state.camera.c2w()
    app.injector.click(*middle(app))
    app.perform(GoToView(1))
    app.settle(30)
    assert not np.allclose(app.state.camera.c2w(), home)
    worker.current = replace(worker.current, loaded=2, opened=None)
    app.settle()
    assert app.state.inspect is None
    assert app.state.current_view is None
    np.testing.assert_allclose(app.state.camera.c2w(), home)


def test_a_new_scene_ends_the_errors_of_the_one_before(start: Start) -> None:
    app, worker = start()
    app.tell(Notice("error", "captures/nowhere: no such folder"))
    app.settle()
    assert "toasts.0.dismiss" in app.widgets
    worker.current = replace(worker.current, loaded=2)
    app.settle()
    assert "toasts.0.dismiss" not in app.widgets
    assert len(app.state.notices) == 1  # the panel keeps it


def test_a_toast_leaves_an_idle_window_by_itself(start: Start) -> None:
    app, _ = start()
    app.tell(Notice("error", "out of memory"))
    app.settle(10)
    drew = [app.frame() for _ in range(60 * 40)]
    assert "toasts.0.dismiss" not in app.widgets
    assert 0 < sum(drew) < 30  # and that costs few frames


def test_a_scene_without_a_picture_shows_its_nearest_photo_dimmed(start: Start) -> None:
    """It is never the warped picture of another scene."""
    app, worker = start()
    plain = worker.current.scene
    assert plain is not None
    steps = np.linspace(0, 65535, 40).astype(np.uint16)
    ramp = np.broadcast_to(steps[None, :, None], (30, 40, 3))
    scene = replace(plain, photos=Photos.of([ramp for _ in plain.views]))
    worker.answering = False
    worker.current = replace(worker.current, scene=scene, loaded=2, preview=None, opened=None)
    app.perform(GoToView(1))
    app.settle(40)
    left, top, right, bottom = (int(v) for v in app.widgets["viewport"])
    shown = app.pixels()[top:bottom, left:right].astype(float) / 255
    height, width = shown.shape[:2]
    scale = min(width / 40, height / 30)
    row, first = shown[int(height / 2 - 10 * scale)], (width - 40 * scale) / 2
    columns = (first + (np.arange(40) + 0.5) * scale).astype(int)
    apart = np.abs(row[columns] - 0.45 * ramp[0].astype(float) / 65535)
    assert np.median(apart) < 0.01
    assert not app.stale
    for index in scene.split("train"):
        assert nearest_photo(scene, scene.views[index].camera) == index


def test_a_view_of_nothing_says_how_to_come_back(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    words: list[str] = []
    real = viewport_panel._chip
    monkeypatch.setattr(viewport_panel, "_chip", lambda *given: (words.append(given[-1]), real(*given)))
    app, worker = start()
    nothing = "Nothing is seen from here. Reset the view (R)"

    def say(empty: bool) -> list[str]:
        rest(app)
        preview = worker.current.preview
        assert preview is not None
        if empty:
            worker.answering = False
            worker.current = replace(
                worker.current, preview=replace(preview, depth=np.full_like(preview.depth, np.nan))
            )
        words.clear()
        app.settle(3)
        worker.answering = True
        return list(dict.fromkeys(words))

    assert say(empty=True) == []  # it is where the scene begins: resetting would not help
    x, y = middle(app)
    app.injector.drag((x, y), (x + 60, y + 10))
    assert say(empty=False) == []
    assert say(empty=True) == [nothing]
    app.injector.key(imgui.Key.r)
    assert say(empty=True) == []


@pytest.mark.parametrize("failed", [False, True])
def test_the_next_scene_takes_the_method_if_that_was_taken_here(start: Start, failed: bool) -> None:
    app, worker = start()
    before = app.state.settings = RunSettings(changes={"rays": "9"})
    for one in (UseMethod("voxels"), InOrder((SaveUnsaved(), UseMethod("nerf")))):
        number = app.perform(one)
        assert app.state.settings == before
        told = Notice("error" if failed else "info", "told", kind="failed" if failed else "loaded", command=number)
        worker.waiting_notices.append(told)
        app.settle()
        name = "voxels" if isinstance(one, UseMethod) else "nerf"
        after = before if failed else replace(before, method=name, changes={})
        assert app.state.settings == after
        before = after


# ---- frames ---------------------------------------------------------------------------------------------------------


def test_an_idle_window_draws_nothing(start: Start) -> None:
    app, _ = start()
    app.settle(5)
    drew = [app.frame() for _ in range(180)]  # three seconds
    assert any(drew[:60])  # the frames in which the last input settles
    assert not any(drew[90:])


def test_live_figures_are_drawn_seldom(start: Start) -> None:
    app, worker = start()
    for _ in range(90):
        app.frame()
    drew = 0
    for k in range(240):
        worker.current = replace(worker.current, step=200 + k)
        drew += app.frame()
    assert 3 <= drew <= 10  # one per second offscreen, in 4 to 8 seconds: the app may read the clock twice in a frame


def test_both_kinds_of_window_show_the_same(window: Window) -> None:
    for _ in range(10):
        window.poll(0.01)
    worker = scripted.ScriptedWorker(scripted.make_scene())
    app = App(window, worker, time=Clock())
    app.settle(4)
    assert app.state.has_display == window.has_display
    left, top, right, bottom = (int(v) for v in app.widgets["viewport"])
    app.injector.drag((left + 50, top + 50), (left + 80, top + 60))
    app.settle(15)
    assert worker.current.preview is not None
    shown = app.pixels()[top:bottom, left:right]
    app.close()
    np.testing.assert_array_equal(shown, worker.current.preview.rgba[..., :3])


def test_run_ends_when_asked_or_closed(start: Start) -> None:
    app, _ = start()
    turns = iter(range(100))
    app.run(until=lambda: next(turns) == 5)
    assert next(turns) == 6
    app.window.request_close()
    app.run()


def test_reset_asks_first(start: Start) -> None:
    app, worker = start()
    for name in ("bar.reset", "bar.reset_confirm"):
        left, top, right, bottom = app.widgets[name]
        assert not worker.sent
        app.injector.click((left + right) / 2, (top + bottom) / 2)
    assert worker.sent == [Reset()]


@pytest.mark.parametrize("scale", [1.0, 1.5, 3.0])
def test_lengths_follow_the_scale(offscreen: Offscreen, scale: float) -> None:
    width, height = round(1000 * scale), round(700 * scale)
    app = App(offscreen((width, height), scale), scripted.ScriptedWorker(scripted.make_scene()), time=Clock())
    app.settle(5)
    left, top, right, bottom = (v / scale for v in app.widgets["viewport"])
    app.close()
    np.testing.assert_allclose([left, top, right, bottom], [0, 22, 655, 413], atol=14)


def test_every_registered_panel_was_drawn(start: Start) -> None:
    app, _ = start((1600, 1000))
    app.injector.click(*middle(app))
    app.settle()
    assert PANELS.names()
    assert not app.state.notices  # a failing panel would have made one


# ---- pinned rays --------------------------------------------------------------------------------------------------


def test_ctrl_click_pins_a_ray_which_stays_while_the_camera_moves(start: Start) -> None:
    app, worker = start()
    x, y = middle(app)
    imgui.get_io().add_key_event(imgui.Key.mod_ctrl, True)
    app.injector.click(x, y)
    imgui.get_io().add_key_event(imgui.Key.mod_ctrl, False)
    app.settle()
    (pin,) = app.state.snapshot.pins
    assert [command for command in worker.sent if isinstance(command, PinRay)] == [
        PinRay(pin.camera, pin.pixel, id=pin.id)
    ]
    assert app.state.inspect is not None
    assert app.state.inspect.id == pin.id
    before = pin.camera.c2w.copy()
    app.state.camera.orbit(80, 10, 600)
    app.injector.click(x + 60, y)
    app.settle()
    np.testing.assert_array_equal(app.state.snapshot.pins[0].camera.c2w, before)
    assert app.state.inspect.id != pin.id


def test_pins_that_are_shown_are_named_in_the_picture(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[str] = []
    monkeypatch.setattr("viewer.draw.overlays.Overlay._tag", lambda self, box, text, *style: named.append(text))
    app, _ = start()
    app.perform(PinRay(app.state.camera.camera(80, 60), (40, 30)))
    app.perform(PinRay(app.state.camera.camera(80, 60), (20, 30), hidden=True))
    app.settle(1)
    named.clear()
    app.settle(1)
    assert named == ["ray 1"]


def test_the_state_that_a_notice_speaks_of_is_read_with_it(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker publishes a state before its notice. Reading the state first could miss it by a frame."""
    app, worker = start()
    told = Notice("info", "loaded")

    def published_and_told() -> list[Notice]:
        worker.current = replace(worker.current, step=77)
        return [told]

    monkeypatch.setattr(worker, "notices", published_and_told)
    steps: list[int] = []
    monkeypatch.setattr(app._actions, "tell", lambda notice: steps.append(app.state.snapshot.step))
    app._read()
    assert steps == [77]


def test_the_presses_of_a_double_click_may_be_some_pixels_apart(start: Start) -> None:
    app, worker = start()
    rest(app)
    app._focus_behind = lambda: None  # pyright: ignore[reportAttributeAccessIssue]  as before the verdict arrives
    x, y = middle(app)
    app.injector.click(x, y)
    app.injector.click(x + 2, y - 1)
    assert sum(isinstance(command, Inspect) for command in worker.sent) == 1
    assert app.state.focus is not None
    assert app.state.focus is app.state.inspect


def test_a_double_click_opens_a_ray_if_its_first_press_did_not(start: Start) -> None:
    """The first press may have closed a menu, for example."""
    app, worker = start()
    rest(app)
    app._focus_behind = lambda: None  # pyright: ignore[reportAttributeAccessIssue]
    x, y = middle(app)
    app.injector.click(x, y)
    app.state.inspect = None
    app.injector.click(x, y)
    assert sum(isinstance(command, Inspect) for command in worker.sent) == 2
    assert app.state.focus is not None
    assert app.state.focus is app.state.inspect


@pytest.mark.parametrize("kind", ["floater", "several surfaces"])
def test_a_double_click_focuses_the_surface_that_the_verdict_names(
    start: Start, kind: Literal["floater", "several surfaces"]
) -> None:
    app, worker = start()
    x, y = middle(app)
    app.injector.double_click(x, y)
    app.settle()
    opened = worker.current.opened
    assert opened is not None
    assert app.state.focus is None  # the verdict, a surface, has arrived already
    app.state.focus = app.state.inspect
    worker.current = replace(
        worker.current, opened=replace(opened, verdict=Verdict(kind, ("one layer",), 7.5, (), "good"))
    )
    app.settle(40)  # the camera eases there
    np.testing.assert_allclose(app.state.camera.pivot, opened.ray.origin + 7.5 * opened.ray.direction, atol=1e-4)
    app.state.focus = app.state.inspect
    app.state.camera.orbit(80, 10, 600)  # a user who moves on meanwhile is not moved back
    pivot = app.state.camera.pivot.copy()
    app.settle(40)
    assert app.state.focus is None
    np.testing.assert_array_equal(app.state.camera.pivot, pivot)


def test_a_render_mode_is_asked_for_with_a_key(start: Start) -> None:
    app, worker = start()
    app.injector.key(imgui.Key._2)
    app.settle()
    assert worker.views[-1].mode == "view-dependence"
    app.injector.key(imgui.Key._1)
    app.settle()
    assert worker.views[-1].mode == "colour"


# ---- methods without samples, and of whole cameras ------------------------------------------------------------------


def test_a_mode_that_the_method_cannot_draw_is_refused_with_the_reason(start: Start) -> None:
    app, worker = start()
    worker.current = replace(worker.current, method="nearest-view")
    app.injector.key(imgui.Key._2)
    app.settle()
    assert app.state.mode == "colour"
    assert {view.mode for view in worker.views} == {"colour"}  # the viewport keeps its picture
    told = [shown.notice for shown in app.state.notices]
    assert [notice.text for notice in told] == [
        "method nearest-view keeps no samples along a ray: it cannot show view-dependence"
    ]
    worker.current = replace(worker.current, method="nerf")
    app.injector.key(imgui.Key._2)
    app.settle()
    worker.current = replace(worker.current, method="nearest-view")  # another method, while the mode is shown
    app.settle()
    assert worker.views[-1].mode == app.state.mode == "colour"


def test_the_status_bar_says_what_the_picture_shows(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    app, worker = start()
    app.settle()
    assert "status.caption" not in app.widgets
    texts: list[str] = []
    draw_text = imgui.text_colored
    monkeypatch.setattr(imgui, "text_colored", lambda color, text: [texts.append(text), draw_text(color, text)])
    caption = "the nearest training photo: view 3 (12° aside, 0.3 units away)"
    for words, ends in ((caption, caption), (caption * 9, "…")):
        preview = worker.current.preview
        assert preview is not None
        worker.current = replace(worker.current, preview=replace(preview, caption=words))
        worker.answering = False
        app.settle()
        assert "status.caption" in app.widgets
        assert app.widgets["status.caption"][2] <= app.window.size()[0]
        assert any(caption[:20] in text and text.endswith(ends) for text in texts)


def test_a_picture_without_depth_is_nothing_only_if_the_method_has_samples(start: Start) -> None:
    _, worker = start()
    preview = worker.current.preview
    assert preview is not None
    blank = replace(worker.current, preview=replace(preview, depth=np.full_like(preview.depth, np.nan)))
    assert viewport_panel._sees_nothing(blank)
    assert not viewport_panel._sees_nothing(replace(blank, method="nearest-view"))
    assert not viewport_panel._sees_nothing(worker.current)


def test_nothing_to_train_is_said_in_the_bars(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    app, worker = start()
    worker.current = replace(worker.current, method="nearest-view", status="finished", step=0, total_steps=0)
    texts: list[str] = []
    draw_text = imgui.text_colored
    monkeypatch.setattr(imgui, "text_colored", lambda color, text: [texts.append(text), draw_text(color, text)])
    app.settle()
    assert "nothing to train" in texts
    assert not {"step 0", "finished"} & set(texts)
    for button in ("bar.train", "bar.step"):
        left, top, right, bottom = app.widgets[button]
        app.injector.click((left + right) / 2, (top + bottom) / 2)
        app.settle()
    assert worker.sent == []
