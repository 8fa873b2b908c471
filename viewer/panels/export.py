"""The export panel: a camera path as a video, and model files, with estimate, progress and cancel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.user_paths import own_path
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.paths.steps import capture_distance, training_size
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import CancelExport, Export, StartExport
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.rendering.export.requests import ExportModel

from ..commands.registry import with_keys
from ..model.state import Action, AppState, FilmForm, StartFilmExport
from ..ui.contract import PANELS, Ui
from ..ui.text import duration, number
from ..ui.widgets import button, field_beside, field_width, hint, path_line, same_line_if_fits

CANCEL = f"{icons.ICON_FA_XMARK}  Cancel"
MAX_FRAMES, MAX_FPS, MAX_SIDE, MAX_RADIUS, MAX_OPTION = 10_000, 240, 8192, 1e4, 1e4
MODEL = f"{icons.ICON_FA_CUBE}  Write model"
PNG = "PNG frames"
LONGEST = "elevation"  # the longest label, which sets the width of all fields


@dataclass(frozen=True)
class OwnPath:
    """The photos' size in pixels and the cameras' distance in scene units, computed once because photos can be many."""

    width: int
    height: int
    radius: float

    @staticmethod
    def of(scene: Scene) -> OwnPath:
        return OwnPath(*training_size(scene), capture_distance(scene))


@PANELS.register("export")
class ExportPanel:
    title = "Export"
    dock: Literal["right"] = "right"
    order = 3

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._own = OwnPath(0, 0, 0.0)

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot, form = state.snapshot, state.film
        if snapshot.scene is None:
            hint(ui, "Open a scene first: then an orbit around it can be written as a video.")
            return
        if snapshot.scene is not self._scene:
            self._scene, self._own = snapshot.scene, OwnPath.of(snapshot.scene)
        running = snapshot.export is not None and snapshot.export.state == "running"
        if snapshot.export is not None:
            _progress(ui, snapshot.export)
        if running and button(ui, CANCEL, "export.cancel", tip="stop and leave no file"):
            yield CancelExport()
        imgui.begin_disabled(running)
        _form(ui, form, self._own)
        imgui.end_disabled()
        if running:
            return
        hint(ui, estimate(form, self._own, snapshot.preview_rays_per_second, snapshot.frame_share))
        tip = with_keys("training goes on", "file.export")
        start = f"{icons.ICON_FA_FILM}  Export {PATHS.get(form.path).label.lower()}"
        if button(ui, start, "export.start", enabled=bool(form.file.strip()), tip=tip):
            yield StartFilmExport()
        yield from _models(ui, state)


def estimate(form: FilmForm, own: OwnPath, speed: float, share: float) -> str:
    """Describe the video, and estimate its time from the measured speed of drawing in rays per second.

    share: the export's share of the time while training goes on.
    """
    width, height = form.width or own.width, form.height or own.height
    film = f"{form.frames:,} frames of {width:,} × {height:,}, {form.frames / form.fps:.1f} s of video"
    if speed <= 0:
        return f"{film}; the time it takes is not measured yet"
    alone = form.frames * width * height / speed
    return f"{film}; takes about {duration(alone)}, while training up to {duration(alone / share)}"


def _form(ui: Ui, form: FilmForm, own: OwnPath) -> None:
    _kind(ui, form)
    if imgui.begin_table("form", 2, imgui.TableFlags_.sizing_stretch_same | imgui.TableFlags_.no_pad_outer_x):
        form.frames = round(_number(ui, "frames", form.frames, (1, MAX_FRAMES), "%.0f"))
        form.fps = _number(ui, "fps", form.fps, (1, MAX_FPS), "%.4g")
        for name in PATHS.get(form.path).options:
            _option(ui, form, name, own)
        for side, photos in (("width", own.width), ("height", own.height)):
            value: int = getattr(form, side)
            shown = "%.0f px" if value else f"auto, {photos:,}"
            setattr(form, side, round(_number(ui, side, value, (0, MAX_SIDE), shown)))
        imgui.end_table()
    field_beside(ui, PNG, "")  # a box is at most as wide as an empty button
    _, form.file = imgui.input_text_with_hint("##file", "orbit.mp4", form.file)
    ui.mark("export.file")
    same_line_if_fits(f"    {PNG}")
    _, form.png_frames = imgui.checkbox(PNG, form.png_frames)
    ui.mark("export.png")
    imgui.set_item_tooltip("also write every frame as a PNG, in a folder beside the video")


def _kind(ui: Ui, form: FilmForm) -> None:
    """The box for the kind of path, if there is more than one."""
    names = list(PATHS.names())
    if len(names) < 2:
        return
    field_width(ui, "path")
    at = names.index(form.path) if form.path in names else 0
    changed, at = imgui.combo("path##export", at, [PATHS.get(name).label for name in names])
    ui.mark("export.path")
    if changed:
        form.path, form.frames = names[at], PATHS.get(names[at]).default_frames or form.frames


def _option(ui: Ui, form: FilmForm, name: str, own: OwnPath) -> None:
    """A field for an option of this kind of path. 0 means its default, except for an elevation."""
    limits, shown = (-MAX_OPTION, MAX_OPTION), "%.4g"
    if name == "elevation":
        limits, shown = (-90.0, 90.0), "%.1f°"
    elif name == "radius":
        limits = (0.0, MAX_RADIUS)
    value = form.options.get(name, 0.0)
    if not value and name != "elevation":
        shown = f"auto, {number(own.radius, 3)}" if name == "radius" else "auto"
    value = _number(ui, name, value, limits, shown)
    if value or name == "elevation":
        form.options[name] = value
    else:
        form.options.pop(name, None)


def _models(ui: Ui, state: AppState) -> Iterator[Action]:
    """The field and the button for model files, if any kind of them is registered."""
    kinds = [EXPORTS.get(name) for name in EXPORTS.names()]
    if not kinds:
        return
    imgui.separator()
    field_beside(ui, MODEL)
    _, state.model_file = imgui.input_text_with_hint("##model", f"model{kinds[0].suffix}", state.model_file)
    ui.mark("export.model_file")
    imgui.same_line()
    tip = "; ".join(f"{kind.suffix}: {kind.summary}" for kind in kinds)
    if button(ui, MODEL, "export.model", enabled=bool(state.model_file.strip()), tip=tip):
        yield StartExport(ExportModel(own_path(Path(state.model_file.strip()))))


def _number(ui: Ui, label: str, value: float, limits: tuple[float, float], shown: str) -> float:
    """The form's next number field. It can be dragged, or edited after a double click."""
    low, high = limits
    imgui.table_next_column()
    field_width(ui, LONGEST)
    speed = min((high - low) / 1000, 0.5)
    _, value = imgui.drag_float(f"{label}##export", value, speed, low, high, shown, imgui.SliderFlags_.always_clamp)
    ui.mark(f"export.{label}")
    if low == 0:
        imgui.set_item_tooltip("0: as the photos were taken")
    return min(max(value, low), high)


def _progress(ui: Ui, export: Export) -> None:
    if export.state == "running":
        share = export.done / max(export.total, 1)
        left = f", {duration(export.seconds_left)} left" if export.seconds_left is not None else ""
        imgui.progress_bar(share, ImVec2(-1, 0), f"{100 * share:.0f} %")
        ui.mark("export.progress")
        hint(ui, f"Exporting {export.file.name}: {100 * share:.0f} %{left}")
    elif export.state == "done":
        hint(ui, "Done:", ui.theme.good)
        path_line(ui, export.file, "export.copy")
    elif export.state == "cancelled":
        hint(ui, "Cancelled: nothing was kept.")
    else:
        hint(ui, "The export failed and left no file: see Notices.", ui.theme.error)
