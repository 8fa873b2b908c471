"""Every panel draws in every state, without GL, and its widgets return the right actions when clicked."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
from imgui_bundle import ImVec2, imgui, implot
from panel_screen import Screen
from panel_states import (
    bare_ray,
    bare_snapshot,
    make_camera,
    make_opened,
    make_radiance,
    make_ray,
    make_ray_history,
    make_scene,
    make_snapshot,
    make_state,
    states,
)

from nerf_core.common.configs import constants
from nerf_core.common.text import triple, vector
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, Lens
from nerf_core.geometry.paths import PATHS, Option
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import (
    CancelExport,
    EditPin,
    ExportRays,
    InOrder,
    Inspect,
    LoadCheckpoint,
    OfRun,
    OpenScene,
    Pause,
    PinRay,
    Reset,
    SaveCheckpoint,
    SaveUnsaved,
    SetShare,
    Snapshot,
    Status,
    Train,
    UnpinRay,
    UseMethod,
)
from nerf_core.methods import METHODS
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.probe import RayHistory, Source, TrainingViews
from nerf_core.probe.axis import contracted_axis
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.training.settings import RunSettings
from viewer.commands.registry import USER_COMMANDS
from viewer.draw.damage import VERTEX
from viewer.draw.picture_stack import cards
from viewer.model.state import (
    Action,
    FilmForm,
    FocusOn,
    FrameScene,
    GoToView,
    ResetView,
    SampleRef,
    SetDisc,
    SetPointDepth,
    ShownNotice,
    StartFilmExport,
)
from viewer.panels.walk import Space
from viewer.ui.contract import PANELS

# ---- the contract -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(420, 700), (800, 240), (120, 90), (20, 20)])
@pytest.mark.parametrize("name", PANELS.names())
def test_a_panel_draws_in_every_state_and_size(screen: Screen, name: str, size: tuple[int, int]) -> None:
    panel = PANELS.get(name)()
    screen.size = size
    assert panel.title
    assert panel.dock in ("right", "bottom", "bottom_right", "overlay")
    for state in states().values():
        for place in ((-100.0, -100.0), (60.0, 60.0), (200.0, 120.0)):  # hovering must not fail either
            imgui.get_io().add_mouse_pos_event(*place)
            for _ in range(2):
                assert all(isinstance(action, Action) for action in screen.frame(panel, state))


def test_titles_are_unique() -> None:
    titles = [PANELS.get(name)().title for name in PANELS.names()]
    assert len(set(titles)) == len(titles)


# ---- training ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "widget", "action"),
    [
        ("paused", "training.start", Train()),
        ("ready", "training.start", Train()),
        ("training", "training.pause", Pause()),
        ("paused", "training.step", Train(1)),
        ("training", "training.save", SaveCheckpoint(Path("run/last.safetensors"))),
    ],
)
def test_training_buttons(screen: Screen, status: Status, widget: str, action: Action) -> None:
    assert screen.click(PANELS.get("training")(), make_state(make_snapshot(status)), widget) == [action]


@pytest.mark.parametrize("widget", ["training.start", "training.step"])
def test_a_finished_training_does_not_start_again(screen: Screen, widget: str) -> None:
    assert screen.click(PANELS.get("training")(), make_state(make_snapshot("finished")), widget) == []


@pytest.mark.parametrize(
    ("panel", "widget", "action"),
    [
        ("training", "training.reset", Reset()),
        ("training", "training.load", LoadCheckpoint(Path("run/last.safetensors"))),
        ("scene", "scene.demo", OpenScene(None, RunSettings(), train=True)),
    ],
)
def test_actions_that_discard_steps_ask_first(
    screen: Screen, panel: str, widget: str, action: Action, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "last.safetensors").touch()
    monkeypatch.chdir(tmp_path)
    drawn, state = PANELS.get(panel)(), make_state(make_snapshot("paused"))
    asked = "scene.open" if panel == "scene" else widget
    assert screen.click(drawn, state, widget) == []
    assert screen.click(drawn, state, f"{asked}_keep") == []
    assert f"{asked}_confirm" not in screen.widgets
    assert screen.click(drawn, state, widget) == []
    assert screen.click(drawn, state, f"{asked}_confirm") == [action]
    assert f"{asked}_confirm" not in screen.widgets
    screen.click(drawn, state, widget)
    assert state.snapshot.scene is not None
    assert isinstance(action, OfRun)
    assert screen.click(drawn, state, f"{asked}_save") == [InOrder((SaveUnsaved(folder=tmp_path), action))]


def test_loading_a_missing_file_discards_nothing_and_asks_nothing(screen: Screen) -> None:
    state = make_state(make_snapshot("paused"))
    path = Path("run/last.safetensors")
    assert screen.click(PANELS.get("training")(), state, "training.load") == [LoadCheckpoint(path)]


def test_saved_steps_are_replaced_without_a_question(screen: Screen) -> None:
    state = make_state(replace(make_snapshot("paused"), saved_step=12_400))
    path = Path("run/last.safetensors")
    assert screen.click(PANELS.get("training")(), state, "training.load") == [LoadCheckpoint(path)]


def test_the_share_is_sent_once_when_the_slider_is_let_go(screen: Screen) -> None:
    panel, state = PANELS.get("training")(), make_state(make_snapshot())
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["training.share"]
    y = (top + bottom) / 2
    actions = screen.drag(panel, state, ((left + right) / 2, y), (right - 40, y), (right + 50, y))
    assert len(actions) == 1
    assert isinstance(actions[0], SetShare)
    assert actions[0].train == pytest.approx(0.95)


# ---- scene, view, export ----------------------------------------------------------------------------------------


def test_opening_a_folder_keeps_the_options(screen: Screen) -> None:
    state = make_state(Snapshot())
    state.open_path = " captures/fox "
    state.settings = RunSettings(LoadOptions(downscale=4), seed=3)
    opened = OpenScene(Path("captures/fox"), state.settings, train=True)
    assert screen.click(PANELS.get("scene")(), state, "scene.open") == [opened]
    paused = replace(opened, train=False)
    assert screen.click(PANELS.get("scene")(), state, "scene.open_paused") == [paused]


def test_the_next_capture_is_opened_at_the_size_that_was_chosen(screen: Screen) -> None:
    panel, state = PANELS.get("scene")(), make_state(Snapshot())
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, _, bottom = screen.widgets["scene.downscale"]
    y = (top + bottom) / 2
    screen.drag(panel, state, (left + 3, y), (left + 60, y), (left + 120, y))
    assert 1 < state.settings.load.downscale <= 64


@pytest.mark.parametrize("name", ["auto", *METHODS.names()])
def test_the_start_panel_offers_every_method(screen: Screen, name: str) -> None:
    state = make_state(Snapshot())
    state.settings = RunSettings(method="nerf" if name == "auto" else "auto", changes={"rays": "9"})
    panel = PANELS.get("scene")()
    screen.click(panel, state, "scene.start")
    screen.click(panel, state, f"scene.start.{name}")
    assert (state.settings.method, state.settings.changes) == (name, {})


def test_another_method_starts_over_after_a_question(screen: Screen) -> None:
    panel, state = PANELS.get("scene")(), make_state(replace(make_snapshot("paused"), method="nerf"))
    screen.click(panel, state, "scene.method")
    assert screen.click(panel, state, "scene.method.voxels") == []
    assert screen.click(panel, state, "scene.method_keep") == []
    assert state.settings.method == "auto"
    screen.click(panel, state, "scene.method")
    screen.click(panel, state, "scene.method.voxels")
    assert screen.click(panel, state, "scene.method_confirm") == [UseMethod("voxels", train=True)]


def test_what_cannot_be_opened_forgets_nothing_and_is_not_asked_about(screen: Screen, tmp_path: Path) -> None:
    """An empty folder, say. The worker says what is wrong."""
    panel, state = PANELS.get("scene")(), make_state(make_snapshot("paused"))
    state.open_path = str(tmp_path)
    (opening,) = screen.click(panel, state, "scene.open")
    assert isinstance(opening, OpenScene)
    assert opening.path == tmp_path
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    assert screen.click(panel, state, "scene.open") == []
    assert "scene.open_confirm" in screen.widgets


def test_another_method_asks_nothing_if_nothing_is_lost(screen: Screen) -> None:
    panel, state = PANELS.get("scene")(), make_state(replace(make_snapshot("paused"), method="nerf", saved_step=12_400))
    screen.click(panel, state, "scene.method")
    assert screen.click(panel, state, "scene.method.nerf") == []
    screen.click(panel, state, "scene.method")
    assert screen.click(panel, state, "scene.method.voxels") == [UseMethod("voxels", train=True)]


def test_next_and_previous_photo_wrap_around_in_the_training_split(screen: Screen) -> None:
    panel, state = PANELS.get("scene")(), make_state(make_snapshot())
    assert screen.click(panel, state, "scene.next") == [GoToView(0)]
    state.current_view = 19
    assert screen.click(panel, state, "scene.next") == [GoToView(0)]
    assert screen.click(panel, state, "scene.previous") == [GoToView(18)]


def test_switches_write_the_state(screen: Screen) -> None:
    state = make_state(make_snapshot())
    assert screen.click(PANELS.get("view")(), state, "view.cameras") == []
    assert state.show_cameras
    screen.click(PANELS.get("view")(), state, "view.samples")
    assert not state.show_samples
    screen.click(PANELS.get("view")(), state, "view.help")
    assert state.show_help
    screen.click(PANELS.get("help")(), state, "help.close")
    assert not state.show_help


def test_view_buttons(screen: Screen) -> None:
    panel, state = PANELS.get("view")(), make_state(make_snapshot())
    assert screen.click(panel, state, "view.frame") == [FrameScene()]
    assert screen.click(panel, state, "view.reset") == [ResetView()]
    (focus,) = screen.click(panel, state, "view.focus")
    assert isinstance(focus, FocusOn)
    assert state.snapshot.radiance is not None
    np.testing.assert_array_equal(focus.point, state.snapshot.radiance.point)


def test_the_constants_of_the_open_model_can_be_read(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    texts: list[str] = []
    monkeypatch.setattr(imgui, "text_unformatted", texts.append)
    config = NerfConfig(width=128, learning_rate=1.5e-3)
    panel, state = PANELS.get("scene")(), make_state(replace(make_snapshot(), config=config.to_json()))
    screen.size = (360, 900)
    screen.click(panel, state, "scene.constants")
    texts.clear()
    screen.frame(panel, state)
    assert {"128", "0.0015", "float32", "True"} <= set(texts)
    assert len(constants(NerfConfig)) <= len(texts)


class Tilted:
    """A camera path whose option has its default elsewhere than at 0, and whose scene gives the other's default."""

    label, summary, default_frames = "Tilted", "on a slope", 7
    options: ClassVar[Mapping[str, Option]] = {
        "tilt": Option("Of a slope, in degrees; by default 5.", 5.0, -10.0, 10.0, "°"),
        "reach": Option("Of a slope, in scene units.", lambda scene: 2 * scene.radius, 0.5, 100.0),
    }

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None, **options: float
    ) -> tuple[Camera, ...]:
        return (scene.views[0].camera,) * (frames or 7)


@pytest.fixture
def tilted(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a path that the viewer does not know."""
    PATHS.names()
    monkeypatch.setitem(PATHS._items, "tilted", Tilted)
    return "tilted"


@pytest.mark.parametrize("path", PATHS.names())
def test_a_path_brings_its_own_fields(screen: Screen, path: str) -> None:
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    state.film.path = path
    screen.frame(panel, state)
    screen.frame(panel, state)
    known = {name for other in PATHS.names() for name in PATHS.get(other).options}
    assert {f"export.{name}" for name in known} & set(screen.widgets) == {
        f"export.{name}" for name in PATHS.get(path).options
    }
    assert "export.path" in screen.widgets
    assert ("export.model" in screen.widgets) == bool(EXPORTS.names())  # it appears with the first model export


def test_an_options_field_has_the_paths_default_and_limits(screen: Screen, tilted: str) -> None:
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    state.film.path = tilted
    screen.click(panel, state, "export.tilt")
    assert state.film.options == {}  # a field left alone follows the path's default
    for low, value in ((-4000.0, -10.0), (4000.0, 10.0)):
        left, top, right, bottom = screen.widgets["export.tilt"]
        x, y = (left + right) / 2, (top + bottom) / 2
        screen.drag(panel, state, (x, y), (x + low / 2, y), (x + low, y))
        assert state.film.options == {"tilt": value}
    screen.click(panel, state, "export.tilt", button=1)
    assert state.film.options == {}


def test_an_option_can_be_0(screen: Screen, tilted: str) -> None:
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    state.film.path = tilted
    screen.type(panel, state, "export.tilt", "0")
    assert state.film.options == {"tilt": 0.0}
    state.film.options.clear()
    screen.type(panel, state, "export.reach", "0")
    assert state.film.options == {"reach": 0.5}  # the least


def test_another_path_takes_nothing_from_the_form_of_the_last(screen: Screen) -> None:
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    state.film.frames, state.film.options = 300, {"radius": 2.0}
    names = list(PATHS.names())
    screen.click(panel, state, "export.path")
    left, _, right, bottom = screen.widgets["export.path"]
    row = imgui.get_text_line_height_with_spacing()
    screen.drag(panel, state, ((left + right) / 2, bottom + (names.index("test") + 0.7) * row))
    assert (state.film.path, state.film.frames, state.film.options) == ("test", 0, {})


def test_the_form_takes_no_more_frames_than_there_are_held_out_views(screen: Screen) -> None:
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    state.film.path, state.film.frames = "test", 60
    screen.frame(panel, state)
    assert state.film.frames == 4


def test_a_path_that_the_scene_does_not_have_cannot_be_exported(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts: list[str] = []
    monkeypatch.setattr(imgui, "text_wrapped", texts.append)
    panel, state = PANELS.get("export")(), make_state(make_snapshot())
    assert state.snapshot.scene is not None
    scene = replace(state.snapshot.scene, splits={"train": state.snapshot.scene.split("train")})
    state.snapshot, state.film.path = replace(state.snapshot, scene=scene), "test"
    assert screen.click(panel, state, "export.start") == []
    assert texts[-1].startswith("scene spheres has no test views to render")


def test_export_starts_and_cancels(screen: Screen) -> None:
    panel, found = PANELS.get("export")(), states()
    assert screen.click(panel, found["training"], "export.start") == [StartFilmExport()]
    assert screen.click(panel, found["export running"], "export.cancel") == [CancelExport()]
    assert "export.start" not in screen.widgets
    screen.click(panel, found["training"], "export.png")
    assert found["training"].film.png_frames


def test_the_export_shows_its_duration_before_it_starts() -> None:
    from viewer.panels.export import Automatic, estimate

    form, own = FilmForm(), Automatic(60, 200, 150, {})
    assert estimate(form, own, speed=9000.0, share=0.2) == (
        "60 frames of 200 × 150, 2.0 s of video; takes about 3 min 20 s, while training up to 16 min 40 s"
    )
    assert estimate(form, own, speed=0.0, share=0.2).endswith("not measured yet")
    assert estimate(replace(form, frames=5), own, speed=0.0, share=0.2).startswith("5 frames")


@pytest.mark.parametrize("name", ["samples", "evidence", "radiance", "slice"])
def test_a_panel_says_that_the_method_keeps_no_samples_along_a_ray(
    screen: Screen, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    METHODS.names()
    monkeypatch.setitem(METHODS._items, "flat", object)
    texts: list[str] = []
    monkeypatch.setattr(imgui, "text_wrapped", texts.append)
    state = make_state(replace(make_snapshot(), method="flat", opened=None, pins=()))
    state.inspect = Inspect(make_camera(np.array([3.2, 0, 2.4])), (4, 5))
    screen.frame(PANELS.get(name)(), state)
    assert texts == ["There is nothing to show here: method flat keeps no samples along a ray."]


# ---- a ray without samples --------------------------------------------------------------------------------------


@pytest.fixture
def texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The hints that panels draw."""
    found: list[str] = []
    monkeypatch.setattr(imgui, "text_wrapped", found.append)
    return found


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "ray",
            "Click a pixel: here you will see what is known of its ray. Method nearest-view keeps no samples along",
        ),
        ("walk", "Click a pixel: here you will see it go through the whole method"),
        ("rays", "Up to 8 rays stay where they are"),
        ("ray_history", "Pin a ray (Ctrl+click)"),
    ],
)
def test_without_samples_rays_can_be_opened_and_pinned(screen: Screen, texts: list[str], name: str, words: str) -> None:
    state = make_state(replace(make_snapshot(), method="nearest-view", opened=None, pins=()))
    screen.frame(PANELS.get(name)(), state)
    assert texts[0].startswith(words)


@pytest.mark.parametrize(("visits", "plotted"), [(10, True), (300, True), (0, False)])
def test_a_ray_without_samples_says_what_it_lacks(screen: Screen, texts: list[str], visits: int, plotted: bool) -> None:
    panel, state = PANELS.get("ray")(), make_state(bare_snapshot(bare_ray(visits)))
    screen.size = (900, 260)
    screen.frame(panel, state)
    screen.frame(panel, state)
    lacks = "Method nearest-view keeps no samples along a ray: there is no σ, no w and no T, and no verdict."
    assert texts[-1] == lacks
    assert not any("Asking" in text for text in texts)
    assert ("ray.visits" in screen.widgets) == plotted


def test_a_visit_can_be_pointed_at(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    panel, ray = PANELS.get("ray")(), bare_ray()
    state = make_state(bare_snapshot(ray))
    screen.size = (900, 260)
    placed: list[list[ImVec2]] = []
    monkeypatch.setattr("viewer.draw.bare_ray.discs", lambda draw, centres, *_: placed.append(list(centres)))
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert state.pointed_at is None
    x = [at.x for at in placed[-1]]
    np.testing.assert_allclose(np.corrcoef(x, ray.visited)[0, 1], 1)  # they lie at their t
    assert all(above.y < below.y for above, below in pairwise(placed[-1]))
    imgui.get_io().add_mouse_pos_event(placed[-1][3].x, placed[-1][3].y + 1)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert state.pointed_at == SampleRef(0, 3)


def test_the_view_can_orbit_what_a_ray_without_samples_found(screen: Screen) -> None:
    panel, ray = PANELS.get("view")(), bare_ray()
    (focus,) = screen.click(panel, make_state(bare_snapshot(ray)), "view.focus")
    assert isinstance(focus, FocusOn)
    np.testing.assert_allclose(focus.point, ray.origin + 3.8 * ray.direction)
    assert screen.click(panel, make_state(bare_snapshot(bare_ray(0, None))), "view.focus") == []


def test_a_history_without_weights_shows_colour_and_depth(screen: Screen, texts: list[str]) -> None:
    panel, state = PANELS.get("ray_history")(), make_state(bare_snapshot(bare_ray()))
    screen.size = (900, 260)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert texts[-1] == (
        "Method nearest-view keeps no samples along a ray: there are no weights to show, but colour and depth."
    )
    assert "ray_history.map" in screen.widgets
    assert "ray colours" in screen.pictures
    assert "ray history" not in screen.pictures  # the map


def test_a_render_mode_that_the_method_cannot_draw_is_no_choice(screen: Screen) -> None:
    panel = PANELS.get("view")()
    for method, chosen in (("nerf", "view-dependence"), ("nearest-view", "colour")):
        state = make_state(replace(make_snapshot(), method=method))
        screen.click(panel, state, "view.mode")
        screen.click(panel, state, "view.mode.view-dependence")
        assert state.mode == chosen


def test_a_method_with_nothing_to_train_says_so(screen: Screen, texts: list[str]) -> None:
    panel, state = PANELS.get("training")(), states()["nothing to train"]
    for widget in ("training.start", "training.step"):
        assert screen.click(panel, state, widget) == []
    assert texts[0] == "Nothing to train: method nearest-view has no parameters."
    assert "training.loss" not in screen.widgets  # of which there is none
    assert screen.click(panel, state, "training.save") == [SaveCheckpoint(Path("run/last.safetensors"))]


def test_the_picture_under_the_mouse_comes_to_the_front(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    panel, state = PANELS.get("walk")(), make_state(make_snapshot())
    screen.size = (2600, 300)
    imgui.get_io().display_size = ImVec2(2700, 800)
    names: list[str] = []
    monkeypatch.setattr(imgui, "text_colored", lambda color, text: names.append(text))
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert "4 pictures, front to back" in names
    left, top, right, bottom = screen.widgets["walk.pictures 5 0"]
    boxes = cards([(40, 30)] * 4, (right - left, bottom - top))
    for box, name in ((boxes[0], "1 of 4: plane 0"), (boxes[3], "4 of 4: plane 3")):
        names.clear()
        imgui.get_io().add_mouse_pos_event(left + box[2] - 2, top + box[1] + 2)  # its upper right corner
        screen.frame(panel, state)
        screen.frame(panel, state)
        assert name in names
    assert {f"##5 0 {k}" for k in range(4)} <= set(screen.pictures)


# ---- the ray and its point --------------------------------------------------------------------------------------


def test_the_radiance_point_is_dragged_along_the_ray(screen: Screen) -> None:
    panel, state = PANELS.get("ray")(), make_state(make_snapshot())
    screen.size = (900, 260)
    for _ in range(3):
        screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["ray.point"]
    x, y = (left + right) / 2, (top + bottom) / 2
    actions = screen.drag(panel, state, (x, y), (x + 30, y), (x - 40, y), (x - 4000, y))
    assert actions
    assert all(isinstance(action, SetPointDepth) for action in actions)
    depths = [action.t for action in actions if isinstance(action, SetPointDepth) and action.t is not None]
    radiance, ray = state.snapshot.radiance, state.snapshot.ray
    assert radiance is not None
    assert ray is not None
    assert min(depths) == pytest.approx(ray.near)  # never behind the ray's start
    assert max(depths) > radiance.t


def test_axes_stay_while_the_same_ray_is_trained_on(screen: Screen) -> None:
    from viewer.panels.ray import RayPanel

    panel, state = RayPanel(), make_state(make_snapshot())
    screen.size = (900, 260)
    before: list[tuple[float, float]] = []
    for density, changes in ((40.0, False), (4.0, False), (40.0, True)):
        ray = make_ray(density, step=state.snapshot.step + 1)
        if changes:
            ray = replace(ray, pixel=(1, 2), near=1.0, far=9.0, depth_median=8.0)
        opened = replace(make_opened(ray), ray=ray)
        state.snapshot = replace(state.snapshot, opened=opened, step=ray.step)
        for _ in range(2):
            screen.frame(panel, state)
        before.append(panel.plots.shown())
    assert before[0] == before[1]
    assert before[1] != before[2]


def test_the_axis_shows_the_part_with_weight_or_the_whole_ray(screen: Screen) -> None:
    """Also over contracted distance, which is offered where the scene is contracted."""
    from viewer.panels.ray import RayPanel

    panel, state = RayPanel(), make_state(make_snapshot())
    opened = state.snapshot.opened
    assert opened is not None
    ray, scene = replace(opened.ray, far=300.0), replace(opened.scene, synthetic=False)
    opened = replace(opened, ray=ray, scene=scene)
    state.snapshot = replace(state.snapshot, opened=opened, scene=scene)
    screen.size = (1200, 300)
    screen.frame(panel, state)
    part = panel.plots.shown()
    assert part[1] < 10
    screen.click(panel, state, "ray.overview")
    assert panel.plots.shown()[1] > 300
    screen.click(panel, state, "ray.overview")
    assert panel.plots.shown() == part
    for shown in ("contracted", "t"):
        screen.click(panel, state, "ray.contracted")
        screen.frame(panel, state)
        assert state.axis == shown
    state.axis = "contracted"
    screen.frame(panel, state)
    screen.click(panel, state, "ray.overview")
    axis = contracted_axis(ray, scene)
    assert axis is not None
    assert axis.turn is not None
    assert axis.turn < panel.plots.shown()[1] < 2.1 * axis.turn
    state.snapshot = replace(state.snapshot, scene=replace(scene, synthetic=True))
    screen.frame(panel, state)
    assert "ray.contracted" not in screen.widgets


def test_the_last_tick_of_a_contracted_axis_is_not_clipped(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    from viewer.draw import ray_plots
    from viewer.panels.ray import RayPanel

    panel, state = RayPanel(), make_state(make_snapshot())
    opened = state.snapshot.opened
    assert opened is not None
    ray, scene = replace(opened.ray, far=300.0), replace(opened.scene, synthetic=False)
    opened = replace(opened, ray=ray, scene=scene)
    state.snapshot = replace(state.snapshot, opened=opened, scene=scene)
    state.axis, screen.size = "contracted", (700, 300)
    screen.frame(panel, state)
    rooms: list[float] = []
    axis, implot = contracted_axis(ray, scene), ray_plots.implot
    assert axis is not None
    panel.plots.show(*axis.place(np.array([20.0, 100.0])).tolist())
    begin_plot, end_plot = implot.begin_plot, implot.end_plot

    def begun(title: str, size: ImVec2, flags: int) -> bool:
        """Note where the plot ends, with all that is beside it."""
        rooms.append(imgui.get_cursor_screen_pos().x + size.x)
        return begin_plot(title, size, flags)

    def ended() -> None:
        """Take off where the last tick's label ends."""
        low, high = panel.plots.shown()
        places, labels = axis.ticks(low, high)
        tick = implot.get_plot_pos().x + (places[-1] - low) / (high - low) * implot.get_plot_size().x
        assert labels[-1] == "100"
        rooms[-1] -= tick + imgui.calc_text_size(labels[-1]).x / 2
        end_plot()

    monkeypatch.setattr(implot, "begin_plot", begun)
    monkeypatch.setattr(implot, "end_plot", ended)
    screen.frame(panel, state)
    assert len(rooms) == 3
    assert 0 <= min(rooms) <= max(rooms) < screen.em


def test_the_strip_of_the_whole_ray_says_what_it_runs_over(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    from viewer.panels.ray import RayPanel

    panel, state = RayPanel(), make_state(make_snapshot())
    tips: list[str] = []
    monkeypatch.setattr(imgui, "set_item_tooltip", tips.append)
    opened = state.snapshot.opened
    assert opened is not None
    for synthetic in (True, False):
        scene = replace(opened.scene, synthetic=synthetic)
        state.snapshot = replace(state.snapshot, opened=replace(opened, scene=scene), scene=scene)
        tips.clear()
        screen.frame(panel, state)
        (tip,) = (tip for tip in tips if tip.startswith("the whole ray"))
        assert ("over contracted distance" in tip) == (not synthetic)


def test_the_median_depth_can_be_asked_for_again(screen: Screen) -> None:
    panel, state = PANELS.get("radiance")(), make_state(make_snapshot())
    assert state.inspect is not None
    assert screen.click(panel, state, "radiance.surface") == []  # it is shown already
    state.inspect = replace(state.inspect, point_t=3.0)
    assert screen.click(panel, state, "radiance.surface") == [SetPointDepth(None)]


@pytest.mark.parametrize("widget", ["radiance.disc", "radiance.sphere"])
@pytest.mark.parametrize("place", [(0.5, 0.5), (0.3, 0.4), (0.7, 0.6)])
def test_hover_reads_the_direction_under_the_mouse(screen: Screen, widget: str, place: tuple[float, float]) -> None:
    """The field is rgb = 0.5 − 0.5 v, so the colour gives the direction v. Its mark must lie under the mouse."""
    from viewer.panels.radiance import RadiancePanel

    panel, state = RadiancePanel(), make_state(make_snapshot())
    radiance = state.snapshot.radiance
    assert radiance is not None
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, right, bottom = screen.widgets[widget]
    x, y = left + place[0] * (right - left), top + place[1] * (bottom - top)
    imgui.get_io().add_mouse_pos_event(x, y)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert panel.hovered is not None
    direction, rgb = panel.hovered
    np.testing.assert_allclose(np.linalg.norm(direction), 1)
    np.testing.assert_allclose(rgb, 0.5 - 0.5 * direction, atol=0.06)
    if widget == "radiance.sphere":
        back = radiance.sphere_position(direction)
    else:
        on_disc = radiance.disc_position(direction)
        back = ((on_disc[0] + 1) / 2, (1 - on_disc[1]) / 2)
    np.testing.assert_allclose(back, place, atol=0.01)


# ---- the microscope's other panels ------------------------------------------------------------------------------


def test_pins_are_opened_hidden_removed_and_written(screen: Screen) -> None:
    panel, state = PANELS.get("rays")(), make_state(make_snapshot())
    pins = state.snapshot.pins
    screen.size = (360, 500)
    assert screen.click(panel, state, "rays.pin") == []  # the opened ray is pinned already
    (asked,) = screen.click(panel, state, "rays.open 2")
    assert isinstance(asked, Inspect)
    assert (asked.id, asked.camera, asked.pixel) == (2, pins[1].camera, pins[1].pixel)
    assert screen.click(panel, state, "rays.remove 1") == [UnpinRay(1)]
    assert screen.click(panel, state, "rays.hide 2") == [EditPin(2, hidden=False)]
    assert screen.click(panel, state, "rays.hide 1") == [EditPin(1, hidden=True)]
    assert screen.click(panel, state, "rays.write") == [ExportRays(Path("rays.json"))]
    assert screen.widgets["rays.name 2"][1] < screen.widgets["rays.name 1"][1]  # the newest is at the top
    state.snapshot = replace(state.snapshot, pins=())
    assert state.inspect is not None
    assert screen.click(panel, state, "rays.pin") == [PinRay.of(state.inspect)]


def test_a_hovered_line_of_the_table_points_at_its_sample(screen: Screen) -> None:
    panel, state = PANELS.get("samples")(), make_state(make_snapshot())
    screen.size = (760, 300)
    screen.frame(panel, state)
    screen.frame(panel, state)
    imgui.get_io().add_mouse_pos_event(120, 120)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert state.pointed_at is not None
    assert state.pointed_at.one == 1
    screen.click(panel, state, "samples.pass 0")
    imgui.get_io().add_mouse_pos_event(120, 120)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert state.pointed_at.one == 0


def test_every_place_in_the_table_belongs_to_one_line(screen: Screen) -> None:
    panel, state = PANELS.get("samples")(), make_state(make_snapshot())
    screen.size = (760, 300)
    screen.frame(panel, state)
    screen.frame(panel, state)
    lines = [screen.widgets[f"samples.row {k}"] for k in range(4)]
    for (_, _, _, bottom), (_, top, _, _) in pairwise(lines):
        assert bottom == top
    for y in np.arange(lines[0][1] + 0.5, lines[3][3]):
        imgui.get_io().add_mouse_pos_event(120, y)
        for _ in range(2):
            state.sample, state.pointed_at = state.pointed_at, None  # as the app does between frames
            screen.frame(panel, state)
        (under,) = [k for k, (_, top, _, bottom) in enumerate(lines) if top <= y < bottom]
        assert state.sample == state.pointed_at == SampleRef(1, under)


def test_a_sample_is_found_only_on_its_stretch_and_close_to_it() -> None:
    from viewer.draw.ray_steps import Steps, sample_at, steps_of

    (_, fine) = steps_of(make_ray())
    gap = replace(fine, t=np.array([2.0, 3.0, 3.1]), until=np.array([2.5, 3.1, 3.2]))

    def at(t: float, *passes: Steps) -> int | None:
        found = sample_at(passes or (gap,), t, 0.05)
        return None if found is None else found[1]

    assert [at(t) for t in (1.9, 1.96, 2.1, 2.49, 2.54, 2.6, 2.96)] == [None, 0, 0, 0, 0, None, 1]
    assert [at(t) for t in (3.05, 3.09, 3.11, 3.24, 3.3, 5.0)] == [1, 1, 2, 2, None, None]
    other = replace(gap, t=np.array([2.05]), until=np.array([4.0]))
    for t, owner in ((2.1, other), (2.01, gap), (2.8, other), (3.11, gap)):
        assert (found := sample_at((gap, other), t, 0.05)) is not None
        assert found[0] is owner
    assert sample_at((), 2.0, 0.05) is None


@pytest.mark.parametrize("choice", ["on", "off"])
def test_a_choice_of_the_density_axis_stays_from_ray_to_ray(screen: Screen, choice: str) -> None:
    from viewer.panels.ray import RayPanel

    panel, state = RayPanel(), make_state(make_snapshot())
    screen.size = (900, 420)
    screen.frame(panel, state)
    wanted = panel.plots.log_density  # the automatic choice
    screen.click(panel, state, f"ray.log {choice}")
    assert panel.plots.log_density == (choice == "on")
    for density in (0.5, 4000.0):
        ray = replace(make_ray(density), pixel=(int(density), 2))
        state.snapshot = replace(state.snapshot, opened=replace(make_opened(ray), ray=ray))
        screen.frame(panel, state)
        assert panel.plots.log_density == (choice == "on")
    screen.click(panel, state, "ray.log auto")
    ray = make_ray()
    state.snapshot = replace(state.snapshot, opened=replace(make_opened(ray), ray=ray))
    screen.frame(panel, state)
    assert panel.plots.log_density == wanted


def test_the_table_goes_to_the_sample_that_is_pointed_at_elsewhere(screen: Screen) -> None:
    panel, state = PANELS.get("samples")(), make_state(make_snapshot())
    screen.size = (760, 300)

    def shown() -> set[str]:
        screen.frame(panel, state)
        screen.frame(panel, state)
        return {name for name in screen.widgets if name.startswith("samples.row")}

    assert "samples.row 2" in shown()
    state.sample = SampleRef(1, 120)
    assert "samples.row 120" in shown()
    assert "samples.row 2" not in shown()
    state.sample = None
    assert "samples.row 120" in shown()
    state.sample = SampleRef(0, 5)  # of the other pass
    assert "samples.row 120" in shown()


def test_a_photo_of_the_evidence_is_flown_to(screen: Screen) -> None:
    panel, state = PANELS.get("evidence")(), make_state(make_snapshot())
    screen.size = (420, 400)
    evidence = state.snapshot.evidence
    assert evidence is not None
    assert screen.click(panel, state, "evidence.2") == [GoToView(int(evidence.views[2]))]


@pytest.mark.parametrize("point", [(0.1, 0.2, 0.3), (0.0, 1.2, 0.9), (-1.0, -0.9, -0.6)])
def test_a_thumbnail_is_of_the_photo_around_the_point(
    screen: Screen, point: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through a lens, and at the photo's rim, beyond which the outermost pixels are repeated."""
    rng, scene = np.random.default_rng(5), make_scene()
    views = tuple(replace(view, camera=replace(view.camera, lens=Lens(k1=-0.2))) for view in scene.views)
    photos = Photos.of([rng.integers(0, 65536, (150, 200, 3), np.uint16) for _ in views])
    scene = replace(scene, views=views, photos=photos)
    training_views = TrainingViews(scene)
    pixels, framed = training_views.project(np.array(point))
    index = rng.permutation(np.flatnonzero(framed))[:12]
    assert len(index) > 3
    snapshot = make_snapshot()
    assert snapshot.opened is not None
    assert snapshot.evidence is not None
    some = snapshot.evidence.at(np.arange(len(index)))
    some = replace(some, point=np.array(point), views=training_views.views[index], pixels=pixels[index])
    snapshot = replace(snapshot, scene=scene, opened=replace(snapshot.opened, evidence=some))
    parts: list[tuple[float, float]] = []
    draw = imgui.image

    def image(texture: imgui.ImTextureRef, size: ImVec2, low: ImVec2, high: ImVec2) -> None:
        assert (low.x, high.x) == (0, 1)
        parts.append((low.y, high.y))
        draw(texture, size, low, high)

    monkeypatch.setattr(imgui, "image", image)
    screen.frame(PANELS.get("evidence")(), make_state(snapshot))
    sheet, half, rims = screen.pictures["evidence"], 16, []
    assert {f"evidence.{k}" for k in range(len(index))} == set(screen.widgets)
    for name, part in zip(screen.widgets, parts, strict=True):
        view = int(some.views[int(name.split(".")[1])])
        first, end = np.rint(np.array(part) * len(sheet)).astype(int)
        (at,), _ = views[view].camera.project(np.array([point]))
        x, y = np.floor(at).astype(int)
        photo = np.pad(scene.images[view] >> 8, ((half, half), (half, half), (0, 0)), "edge")
        np.testing.assert_array_equal(sheet[first:end, :, :3], photo[y : y + 2 * half + 1, x : x + 2 * half + 1])
        assert (sheet[first + half, half, :3] == scene.images[view][y, x] >> 8).all()
        rims.append(min(x, y, 199 - x, 149 - y))
    assert (min(rims) < half) == (point != (0.1, 0.2, 0.3))


def test_the_line_of_a_ray_in_a_photo_passes_through_its_points() -> None:
    from viewer.panels.evidence import epipolar

    ray, camera = make_ray(), make_camera(np.array([0.5, 3.2, 1.0]))
    line = epipolar(camera, ray)
    for t in (2.5, 3.8, 5.5):
        (pixel,), _ = camera.project((ray.origin + t * ray.direction)[None])
        assert np.nanmin(np.linalg.norm(line - pixel, axis=1)) < 3
    inside = make_camera(ray.origin + 3.0 * ray.direction)  # on the ray: a part of it lies behind
    t = np.geomspace(ray.near, ray.far, 96)
    depth = inside.project(ray.origin + t[:, None] * ray.direction)[1]
    assert 0 < (depth > 0).sum() < 96
    np.testing.assert_array_equal(np.isfinite(epipolar(inside, ray)).all(-1), depth > 0)


def test_a_ray_s_line_in_a_panorama_breaks_where_it_leaves_the_picture() -> None:
    from viewer.panels.evidence import epipolar

    ray = make_ray()
    back = np.cross(ray.direction, [0.0, 0.0, 1.0])
    back /= np.linalg.norm(back)  # the ray passes 0.3 behind the camera, from its left to its right
    place = ray.origin + 3.0 * ray.direction - 0.3 * back
    c2w = np.column_stack([ray.direction, np.cross(back, ray.direction), back, place])
    around = Camera(200, 100, 100 / np.pi, 100 / np.pi, 100, 50, c2w, Lens(kind=EQUIRECTANGULAR))
    line = epipolar(around, ray)
    assert np.nanmax(np.abs(np.diff(line[:, 0]))) <= around.width / 2
    assert np.isfinite(line).all(-1).sum() == 95  # of 96


def test_the_photos_angles_are_relative_to_the_current_camera() -> None:
    from viewer.panels.evidence import _angles, _summary

    snapshot = make_snapshot()
    evidence, scene = snapshot.evidence, snapshot.scene
    assert evidence is not None
    assert scene is not None
    for k, view in enumerate(evidence.views[:3].tolist()):
        angles = _angles(evidence, scene.views[view].camera.c2w[:, 3])
        assert angles[k] == pytest.approx(0, abs=1e-3)
        assert (np.delete(angles, k) > 0.01).all()
    np.testing.assert_array_equal(_angles(evidence, evidence.point), evidence.angle)
    cut = replace(evidence, asked=1000, framed=900)
    assert f"Of {len(evidence.views)} training photos that were asked" in _summary(cut)
    assert f"{900 - len(evidence.views)} more have it in their frame; 100 have it outside" in _summary(cut)
    assert "have it in their frame; 2 have it masked; 98 have it outside" in _summary(replace(cut, masked=2))


def test_gains_and_masks_are_told(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    from viewer.panels.scene import _rows

    texts: list[str] = []
    monkeypatch.setattr(imgui, "text_unformatted", texts.append)
    snapshot = make_snapshot()
    screen.frame(PANELS.get("evidence")(), make_state(snapshot))
    assert "1.23" not in texts
    evidence, scene, opened = snapshot.evidence, snapshot.scene, snapshot.opened
    assert evidence is not None
    assert scene is not None
    assert opened is not None
    dimmed = replace(evidence, gain=np.full_like(evidence.gain, 1.23))
    screen.frame(PANELS.get("evidence")(), make_state(replace(snapshot, opened=replace(opened, evidence=dimmed))))
    assert texts.count("1.23") == len(evidence.views)
    width, height = scene.photos.sizes[1]
    masked = replace(scene, photos=scene.photos.masked({1: np.zeros((height, width), bool)}))
    assert ("masks", f"1 of {len(scene.views)} photos") in _rows(masked)
    assert "masks" not in [row[0] for row in _rows(scene)]


def test_the_radiance_is_of_the_layer_the_point_or_the_whole_ray(screen: Screen) -> None:
    from viewer.panels.radiance import shown_of

    panel, state = PANELS.get("radiance")(), make_state(make_snapshot())
    assert (state.radiance_of, shown_of(state, make_radiance(make_ray()))) == (None, "layer")
    for of in ("ray", "point", "layer"):
        screen.click(panel, state, f"radiance.{of}")
        assert state.radiance_of == of
    opened = state.snapshot.opened
    assert opened is not None
    assert opened.radiance is not None
    alone = replace(opened.radiance, layer=None, default="point")  # the point was moved out of all layers
    state.snapshot = replace(state.snapshot, opened=replace(opened, radiance=alone))
    assert shown_of(state, alone) == "point"
    screen.click(panel, state, "radiance.ray")
    screen.click(panel, state, "radiance.layer")
    assert state.radiance_of == "ray"  # it is disabled
    assert screen.click(panel, state, "radiance.normal") == [SetDisc("normal")]


def test_directions_far_from_every_photo_are_hatched() -> None:
    from nerf_core.probe import FAR_DEGREES, unseen
    from viewer.panels.radiance import Pictures

    radiance, evidence = make_snapshot().radiance, make_snapshot().evidence
    assert radiance is not None
    assert evidence is not None
    far = unseen(radiance.directions, evidence)
    seen = evidence.directions[evidence.seen]
    for k in range(0, len(far), 501):
        nearest = np.degrees(np.arccos(np.clip(seen @ radiance.directions[k], -1, 1))).min()
        assert far[k] == (nearest > FAR_DEGREES)
    assert 0.2 < far.mean() < 0.99
    plain = Pictures.of(radiance, replace(evidence, transmittance=evidence.transmittance * 0), "point")
    some = Pictures.of(radiance, evidence, "point")
    assert (plain.sphere != some.sphere).any()
    assert unseen(radiance.directions, None).all()


@pytest.mark.parametrize("around", ["viewer", "normal"])
def test_the_difference_is_the_colour_on_the_ray_minus_the_mean_of_the_observed(
    screen: Screen, around: Literal["viewer", "normal"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However the disc is turned, and wherever the camera has moved since."""
    shown: dict[str, str] = {}
    figures = "viewer.panels.radiance.figures"
    monkeypatch.setattr(figures, lambda ui, name, rows: shown.update({row[0]: row[1] for row in rows}))
    state = make_state(make_snapshot())
    opened, radiance, evidence = state.snapshot.opened, state.snapshot.radiance, state.snapshot.evidence
    assert opened is not None
    assert radiance is not None
    assert evidence is not None
    turned = replace(radiance, around=around, directions=-radiance.directions[::-1], rgb=radiance.rgb[::-1])
    state.snapshot = replace(state.snapshot, opened=replace(opened, radiance=turned))
    sources: dict[Source, tuple[np.ndarray, np.ndarray]] = {
        "layer": (evidence.layer_emitted, radiance.layer_back_rgb), "point": (evidence.emitted, radiance.back_rgb),
        "ray": (evidence.emitted, radiance.back_rgb),
    }  # fmt: skip
    for state.radiance_of, (emitted, back) in sources.items():
        screen.frame(PANELS.get("radiance")(), state)
        mean = emitted[evidence.seen].mean(0)
        assert shown["observed mean"] == triple(mean)
        assert shown["difference here"] == vector(back - mean)


def test_a_slice_shows_the_models_colours_and_those_of_the_photos_near_it(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos near the slice are plotted at their angle in it. The field is rgb = 0.5 − 0.5 v."""
    from viewer.panels.slice import SlicePanel

    lines: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    dots: dict[str, tuple[float, float]] = {}
    monkeypatch.setattr(implot, "plot_line", lambda name, x, y, _: lines.update({name: (x, y)}))
    monkeypatch.setattr(implot, "plot_scatter", lambda name, x, y, _: dots.update({name: (x.item(), y.item())}))
    panel, state = SlicePanel(), make_state(make_snapshot())
    panel.degrees = 40.0
    opened, radiance, evidence = state.snapshot.opened, state.snapshot.radiance, state.snapshot.evidence
    assert opened is not None
    assert radiance is not None
    assert evidence is not None
    turn = np.radians(panel.degrees)
    along = np.array([np.cos(turn), np.sin(turn), 0]) @ radiance.axes
    beside = np.array([-np.sin(turn), np.cos(turn), 0]) @ radiance.axes

    def look(angle: float, out: float = 0.0) -> np.ndarray:
        a, b = np.radians([angle, out])
        return np.cos(b) * (np.sin(a) * along + np.cos(a) * radiance.axes[2]) + np.sin(b) * beside

    looks = ((-70, 0), (0, 0), (35, 10), (35, -14), (20, 0), (120, 0))
    some = replace(
        evidence.at(np.arange(len(looks))),
        directions=np.array([look(*angles) for angles in looks]),
        transmittance=np.array([1, 1, 1, 1, 0.1, 1]),
    )
    state.snapshot = replace(state.snapshot, opened=replace(opened, evidence=some))
    screen.frame(panel, state)
    shown = {f"photo {k} {c}": (looks[k][0], some.observed[k, c]) for k in range(3) for c in range(3)}
    assert set(dots) == set(shown)
    for name, place in dots.items():
        assert place == pytest.approx(shown[name], abs=1e-4)
    for c in range(3):
        angles, values = lines[f"channel {c}"]
        assert (angles.min(), angles.max()) == pytest.approx((-80, 80), abs=2)
        expected = 0.5 - 0.5 * np.array([look(angle)[c] for angle in angles])
        np.testing.assert_allclose(values, expected, atol=0.03)  # read from pixels, which are coarse at the rim


@pytest.mark.parametrize(
    ("t", "wanted"),
    [([1.0, 2.0, 3.0], (1, 3)), ([1.0, 2.0, 7e5], (1, 6)), ([7.0, 9.0], (7, 7)), ([2.0], (2, 2)), ([], (0.5, 6))],
)
def test_the_axis_of_a_stage_ends_where_the_ray_does(t: list[float], wanted: tuple[float, float]) -> None:
    low, high = Space(100.0, True, 0.5, 6.0).limits(np.array(t))
    assert low < high
    assert (low, high) == pytest.approx(wanted, abs=0.04 * max(wanted[1] - wanted[0], 1e-6))


def test_every_stage_is_drawn(screen: Screen) -> None:
    panel, state = PANELS.get("walk")(), make_state(make_snapshot())
    screen.size = (2200, 300)
    screen.frame(panel, state)
    screen.frame(panel, state)
    opened = state.snapshot.opened
    assert opened is not None
    assert {f"walk.{stage.title}" for stage in opened.walk} <= set(screen.widgets)


def test_the_history_is_of_the_opened_pin(screen: Screen) -> None:
    panel, state = PANELS.get("ray_history")(), make_state(make_snapshot())
    screen.size = (900, 260)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert "ray_history.map" in screen.widgets
    state.snapshot = replace(state.snapshot, pins=())
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert "ray_history.map" not in screen.widgets


@pytest.mark.parametrize("apart", [0.06, 0.1, 0.3, 1.0])
@pytest.mark.parametrize(("first", "span"), [(0, 1), (0, 500_000), (98, 2), (381, 9), (381, 11_619), (12_345, 150)])
def test_steps_are_named_at_both_ends_and_where_they_are_round(first: int, span: int, apart: float) -> None:
    from viewer.panels.ray_history import ticks

    last = first + span
    found = ticks(first, last, apart)
    assert (found[0], found[-1]) == (first, last)
    places = np.log1p(np.array(found) - first) / np.log1p(span)
    assert np.diff(places).min() >= apart
    for step in found[1:-1]:
        assert any(step % 10**k == 0 for k in range(7) if 500 * 10**k >= first)  # 381: tens; 12,345: hundreds


def test_known_steps_are_named() -> None:
    from viewer.panels.ray_history import ticks

    assert ticks(0, 12_000, 0.1) == [0, 2, 10, 30, 100, 300, 1000, 3000, 12_000]
    assert ticks(381, 12_000, 0.1) == [381, 385, 400, 500, 1000, 2000, 12_000]


def test_a_history_with_hardly_any_depth_makes_no_vertex_that_is_not_finite(screen: Screen) -> None:
    panel, state = PANELS.get("ray_history")(), make_state(make_snapshot())
    screen.size = (900, 260)
    history = make_ray_history()
    for kept in ([], [0], [8], [3], [2, 3, 6], range(1, 9)):  # a depth alone has no line
        depth = np.full(len(history.depth), np.nan)
        depth[list(kept)] = 3.8
        pin = replace(state.snapshot.pins[0], history=replace(history, depth=depth))
        state.snapshot = replace(state.snapshot, pins=(pin,))
        screen.frame(panel, state)
        for commands in imgui.get_draw_data().cmd_lists:
            vertices = commands.vtx_buffer
            data = ctypes.string_at(vertices.data_address(), vertices.size() * imgui.VERTEX_SIZE)
            assert np.isfinite(np.frombuffer(data, VERTEX)["place"]).all(), list(kept)


def test_the_history_opens_where_the_weights_are_and_follows_them(screen: Screen) -> None:
    from viewer.panels.ray_history import RayHistoryPanel

    panel, state = RayHistoryPanel(), make_state(make_snapshot())
    screen.size = (900, 260)

    def shown(history: RayHistory) -> tuple[float, ...]:
        state.snapshot = replace(state.snapshot, pins=(replace(state.snapshot.pins[0], history=history),))
        for _ in range(3):
            screen.frame(panel, state)
        return panel._x.high.value, panel._t.low.value, panel._t.high.value

    history = make_ray_history()
    weights = np.zeros_like(history.weights)
    weights[3, 40], weights[5, 44], weights[:, 80] = 0.6, 0.5, 0.005
    edges, early = history.edges, slice(0, 6)
    young = replace(
        history, steps=history.steps[early], weights=weights[early], color=history.color[early],
        depth=history.depth[early], opacity=history.opacity[early],
    )  # fmt: skip
    width = edges[1] - edges[0]
    around = edges[40] - 3 * width, edges[45] + 3 * width
    assert shown(young) == pytest.approx((np.log1p(40), *around))
    assert shown(replace(history, weights=0 * weights)) == pytest.approx((np.log1p(12_000), 2, 6))
    assert shown(replace(history, weights=weights)) == pytest.approx((np.log1p(12_000), *around))
    # after the user has zoomed, the axes stay
    left, top, right, bottom = screen.widgets["ray_history.map"]
    imgui.get_io().add_mouse_pos_event((left + right) / 2, (top + bottom) / 2)
    screen.frame(panel, state)
    imgui.get_io().add_mouse_wheel_event(0, -2)
    zoomed = shown(replace(history, weights=weights))
    assert zoomed[1] < around[0] < around[1] < zoomed[2]
    assert shown(replace(history, weights=0 * weights)) == zoomed
    shown(replace(history, weights=weights))
    # a double click takes them back to the weights
    imgui.get_io().delta_time = 0.02
    for down in (True, False, True, False):
        imgui.get_io().add_mouse_button_event(0, down)
        screen.frame(panel, state)
    assert shown(replace(history, weights=weights)) == pytest.approx((np.log1p(12_000), *around))
    assert shown(young) == pytest.approx((np.log1p(40), *around))
    # the axes of another ray begin at its weights
    screen.frame(panel, state)
    imgui.get_io().add_mouse_wheel_event(0, -2)
    assert shown(young) != pytest.approx((np.log1p(40), *around))
    other = replace(young, edges=edges + 1)
    assert shown(other) == pytest.approx((np.log1p(40), around[0] + 1, around[1] + 1))


def test_the_historys_map_shows_at_each_step_the_record_in_force(screen: Screen) -> None:
    """Each record has all of its weight in a bin of its own, and a grey of its own."""
    panel, state, history = PANELS.get("ray_history")(), make_state(make_snapshot()), make_ray_history()
    count, bins = history.weights.shape
    weights = np.zeros_like(history.weights)
    peaks = (np.arange(count) * 37 + 5) % bins
    weights[np.arange(count), peaks] = 1
    greys = np.linspace(0, 1, count)
    history = replace(history, steps=history.steps + 381, weights=weights, color=np.tile(greys[:, None], (1, 3)))
    for records in (count - 2, count):  # the map follows as the history grows
        part = slice(0, records)
        some = replace(
            history, steps=history.steps[part], weights=weights[part], color=history.color[part],
            depth=history.depth[part], opacity=history.opacity[part],
        )  # fmt: skip
        state.snapshot = replace(state.snapshot, pins=(replace(state.snapshot.pins[0], history=some),))
        screen.frame(panel, state)
        drawn, strip = screen.pictures["ray history"], screen.pictures["ray colours"]
        columns = drawn.shape[1]
        assert (drawn.shape[0], strip.shape[:2]) == (bins, (1, columns))
        for x in range(columns):
            step = 381 + np.expm1(x / (columns - 1) * np.log1p(some.steps[-1] - 381))
            k = max(i for i, since in enumerate(some.steps) if since <= step + 1e-3)
            green = drawn[:, x, 1].astype(int)  # grows with the weight over the whole colour map
            assert bins - 1 - green.argmax() == peaks[k]
            assert (green > green.min()).sum() == 1
            assert strip[0, x, :3] == pytest.approx(255 * greys[k], abs=0.6)


def test_the_history_tooltip_describes_the_hovered_record(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    panel, state = PANELS.get("ray_history")(), make_state(make_snapshot())
    shown_texts: list[str] = []
    monkeypatch.setattr(imgui, "set_tooltip", shown_texts.append)
    screen.size = (900, 260)
    for _ in range(3):
        screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["ray_history.map"]
    for x, expected in ((left + 4 * screen.em, "step 0: no depth"), (right - 4 * screen.em, "step 900: depth 3.8")):
        imgui.get_io().add_mouse_pos_event(x, (top + bottom) / 2)
        screen.frame(panel, state)
        screen.frame(panel, state)
        assert shown_texts[-1].startswith(expected)


def test_the_view_panel_uses_the_names_of_the_commands(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    labels: list[str] = []
    for function in ("button", "checkbox"):
        draw = getattr(imgui, function)
        monkeypatch.setattr(
            imgui, function, lambda label, *rest, draw=draw: (labels.append(label), draw(label, *rest))[1]
        )
    screen.frame(PANELS.get("view")(), make_state(make_snapshot()))
    for command in ("camera.reset", "show.ray", "show.cameras", "show.help"):
        assert sum(USER_COMMANDS.get(command).title in label for label in labels) == 1


# ---- notices ----------------------------------------------------------------------------------------------------


def test_a_toast_stays_as_long_as_it_takes_to_read_it(screen: Screen) -> None:
    panel, state = PANELS.get("toasts")(), states()["failed"]
    error = state.notices[2]
    # warnings are only in the panel and the status bar
    for now, shown in ((100.0, {0, 2}), (error.born + 30.0, {2}), (error.born + 5000.0, set())):
        state.time = now
        for _ in range(3):
            screen.frame(panel, state)
        assert {int(name.split(".")[1]) for name in screen.widgets if name.endswith("dismiss")} == shown
    longer = ShownNotice(replace(error.notice, text=100 * error.notice.text), error.born)
    assert longer.ends > error.ends
    state.time = 100.0
    screen.click(panel, state, "toasts.2.dismiss")
    assert state.notices[2].dismissed


@pytest.mark.parametrize("name", ["toasts", "notices"])
def test_a_path_is_shown_once(screen: Screen, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown_texts: list[str] = []
    for function in ("text_unformatted", "text_wrapped"):
        monkeypatch.setattr(imgui, function, shown_texts.append)
    screen.frame(PANELS.get(name)(), states()["failed"])
    assert shown_texts.count("saved step 12,400:") == 1
    assert sum("run/last.safetensors" in text for text in shown_texts) == 1
    assert "out of memory" in shown_texts


def test_the_path_of_a_result_is_copied(screen: Screen) -> None:
    screen.click(PANELS.get("notices")(), states()["failed"], "notices.0.copy")
    assert imgui.get_clipboard_text() == str(Path("run/last.safetensors"))


# ---- texts ------------------------------------------------------------------------------------------------------


def test_hatched_pictures_are_the_colours_with_stripes_where_no_photo_looked() -> None:
    from viewer.panels.radiance import HATCH, ZOOM, _hatched

    rng = np.random.default_rng(0)
    rgb, hidden = rng.uniform(-0.2, 1.2, (5, 7, 3)).astype(np.float32), rng.random((5, 7)) < 0.5
    rgb[1, 2] = np.nan
    found = _hatched(rgb, hidden)
    assert found.dtype == np.uint8
    assert found.shape == (5 * ZOOM, 7 * ZOOM, 4)
    assert (found[..., 3] == 255).all()
    for y in range(5 * ZOOM):
        for x in range(7 * ZOOM):
            color = rgb[y // ZOOM, x // ZOOM].astype(np.float64)
            if hidden[y // ZOOM, x // ZOOM] and (x + y) % HATCH < HATCH // 3:
                color = 0.55 * color + (0.45 if color.mean() < 0.5 else 0.0)
            want = np.clip(np.nan_to_num(color), 0, 1) * 255
            assert (np.abs(found[y, x, :3] - want) <= 0.51).all()


def test_the_capture_panel_says_how_well_poses_were_found(screen: Screen, texts: list[str]) -> None:
    panel, snapshot = PANELS.get("capture")(), make_snapshot("training")
    screen.frame(panel, make_state(snapshot))
    assert not any("have a pose" in text for text in texts)
    assert snapshot.scene is not None
    found = "21 of 21 photos have a pose; 3,210 points, mean error 0.66 pixels"
    screen.frame(panel, make_state(replace(snapshot, scene=replace(snapshot.scene, posed=found))))
    assert found in texts
