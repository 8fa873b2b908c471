"""The export panel: a camera path as a video, and model files, with estimate, progress and cancel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.errors import UserError
from nerf_core.common.names import printable
from nerf_core.common.text import duration, number
from nerf_core.geometry.paths import PATHS, CameraPath, Option
from nerf_core.geometry.paths.steps import training_size
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import CancelExport, Export, StartExport
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.rendering.export.requests import ExportModel

from ..commands.registry import with_keys
from ..model.state import Action, AppState, FilmForm, StartFilmExport
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, field_beside, field_width, hint, path_line, same_line_if_fits

CANCEL = f"{icons.ICON_FA_XMARK}  Cancel"
MAX_FRAMES, MAX_FPS, MAX_SIDE = 10_000, 240, 8192
MODEL = f"{icons.ICON_FA_CUBE}  Write model"
PNG = "PNG frames"
LABELS = ("frames", "fps", "width", "height")  # of the fields that every kind of path has


@dataclass(frozen=True)
class Automatic:
    """What a kind of path takes for the fields that the user leaves alone.

    It is computed once for a scene, because paths can be long and photos many.

    frames: 0 if there is no such path through the scene; `problem` then says why.
    width, height: the training photos' size in pixels.
    options: the defaults of the kind's options, by name.
    """

    frames: int
    width: int
    height: int
    options: dict[str, float]
    problem: str = ""

    @staticmethod
    def of(scene: Scene, kind: type[CameraPath]) -> Automatic:
        options = {name: option.default_in(scene) for name, option in kind.options.items()}
        try:
            return Automatic(len(kind.cameras(scene)), *training_size(scene), options)
        except UserError as error:
            return Automatic(0, *training_size(scene), options, str(error))


@PANELS.register("export")
class ExportPanel:
    title = "Export"
    dock: Literal["right"] = "right"
    order = 3

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._path = ""
        self._own = Automatic(0, 0, 0, {})

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot, form = state.snapshot, state.film
        if snapshot.scene is None:
            hint(ui, "Open a scene first: then a path through it can be written as a video.")
            return
        running = snapshot.export is not None and snapshot.export.state == "running"
        if snapshot.export is not None:
            _progress(ui, snapshot.export)
        if running and button(ui, CANCEL, "export.cancel", tip="stop and leave no file"):
            yield CancelExport()
        imgui.begin_disabled(running)
        _kind(ui, form)
        kind = PATHS.get(form.path)
        if snapshot.scene is not self._scene or form.path != self._path:
            self._scene, self._path, self._own = snapshot.scene, form.path, Automatic.of(snapshot.scene, kind)
        _form(ui, form, kind, self._own)
        imgui.end_disabled()
        if running:
            return
        tip = with_keys("training goes on", "file.export")
        start = f"{icons.ICON_FA_FILM}  Export {kind.label.lower()}"
        possible = bool(form.file.strip()) and not self._own.problem
        if button(ui, start, "export.start", enabled=possible, tip=tip):
            yield StartFilmExport()
        if self._own.problem:
            hint(ui, self._own.problem, ui.theme.warning)
        else:
            hint(ui, estimate(form, self._own, snapshot.preview_rays_per_second, snapshot.frame_share))
        yield from _models(ui, state)


def estimate(form: FilmForm, own: Automatic, speed: float, share: float) -> str:
    """Describe the video, and estimate its time from the measured speed of drawing in rays per second.

    share: the export's share of the time while training goes on.
    """
    frames, width, height = form.frames or own.frames, form.width or own.width, form.height or own.height
    film = f"{frames:,} frames of {width:,} × {height:,}, {frames / form.fps:.1f} s of video"
    if speed <= 0:
        return f"{film}; the time it takes is not measured yet"
    alone = frames * width * height / speed
    return f"{film}; takes about {duration(alone)}, while training up to {duration(alone / share)}"


def _form(ui: Ui, form: FilmForm, kind: type[CameraPath], own: Automatic) -> None:
    longest = max((*LABELS, *kind.options), key=len)
    if imgui.begin_table("form", 2, imgui.TableFlags_.sizing_stretch_same | imgui.TableFlags_.no_pad_outer_x):
        # A kind without a number of its own takes it from the scene, which has no more.
        most = own.frames if kind.default_frames is None else MAX_FRAMES
        shown = "%.0f" if form.frames else f"auto, {own.frames:,}"
        tip = "0: as many as the path has"
        form.frames = round(_number(ui, "frames", form.frames, (0, most), shown, longest, tip)[1])
        form.fps = _number(ui, "fps", form.fps, (1, MAX_FPS), "%.4g", longest)[1]
        for name, option in kind.options.items():
            _option(ui, form, name, option, own.options[name], longest)
        for side, photos in (("width", own.width), ("height", own.height)):
            value: int = getattr(form, side)
            shown, tip = "%.0f px" if value else f"auto, {photos:,}", "0: as the photos were taken"
            setattr(form, side, round(_number(ui, side, value, (0, MAX_SIDE), shown, longest, tip)[1]))
        imgui.end_table()
    field_beside(ui, PNG, "")  # a box is at most as wide as an empty button
    _, form.file = imgui.input_text_with_hint("##file", "film.mp4", form.file)
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
        form.path, form.frames, form.options = names[at], 0, {}  # another kind has other numbers


def _option(ui: Ui, form: FilmForm, name: str, option: Option, default: float, longest: str) -> None:
    """A field for an option of this kind of path. A right click goes back to the default."""
    usual, unit = number(default, 3), option.unit.replace("%", "%%")  # what a field shows is a format
    shown = f"%.4g{unit}" if name in form.options else f"auto, {usual}{unit}"
    value, limits = form.options.get(name, default), (option.least, option.most)
    changed, value = _number(ui, name, value, limits, shown, longest, f"right click: auto, {usual}{option.unit}")
    if changed:
        form.options[name] = value
    if imgui.is_item_clicked(imgui.MouseButton_.right):
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
        yield StartExport(ExportModel(Path(state.model_file.strip())))


def _number(
    ui: Ui, label: str, value: float, limits: tuple[float, float], shown: str, longest: str, tip: str = ""
) -> tuple[bool, float]:
    """The form's next number field: whether the user changed it, and its number within the limits.

    It can be dragged, or edited after a double click. longest: the longest label, which sets the width of all fields.
    """
    low, high = limits
    imgui.table_next_column()
    field_width(ui, longest)
    speed = min((high - low) / 1000, 0.5)
    changed, value = imgui.drag_float(
        f"{label}##export", value, speed, low, high, shown, imgui.SliderFlags_.always_clamp
    )
    ui.mark(f"export.{label}")
    if tip:
        imgui.set_item_tooltip(tip)
    return changed, min(max(value, low), high)


def _progress(ui: Ui, export: Export) -> None:
    if export.state == "running":
        share = export.done / max(export.total, 1)
        left = f", {duration(export.seconds_left)} left" if export.seconds_left is not None else ""
        imgui.progress_bar(share, ImVec2(-1, 0), f"{100 * share:.0f} %")
        ui.mark("export.progress")
        hint(ui, f"Exporting {printable(export.file.name)}: {100 * share:.0f} %{left}")
    elif export.state == "done":
        hint(ui, "Done:", ui.theme.good)
        path_line(ui, export.file, "export.copy")
    elif export.state == "cancelled":
        hint(ui, "Cancelled: nothing was kept.")
    else:
        hint(ui, "The export failed and left no file: see Notices.", ui.theme.error)
