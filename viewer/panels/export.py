"""The export panel: a camera path as a video, and model files, with estimate, progress and cancel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.errors import UserError
from nerf_core.common.language import figure, marked, phrases, tr
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
from ..ui.widgets import button, field_beside, field_width, hint, path_line, rounded, same_line_if_fits, shown

CANCEL, MODEL = marked("Cancel"), marked("Write model")
HELD = ".5g"  # the digits that a field holds: enough for 23.976 fps
MAX_FRAMES, MAX_FPS, MAX_SIDE = 10_000, 240, 8192
PNG = marked("PNG frames")
LABELS = (marked("frames"), marked("fps"), marked("width"), marked("height"))  # of the fields that every path has


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
    title = marked("Export")
    dock: Literal["right"] = "right"
    order = 3

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._path = ""
        self._own = Automatic(0, 0, 0, {})

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot, form = state.snapshot, state.film
        if snapshot.scene is None:
            hint(ui, tr("Open a scene first: then a path through it can be written as a video."))
            return
        running = snapshot.export is not None and snapshot.export.state == "running"
        if snapshot.export is not None:
            _progress(ui, snapshot.export)
        cancel = f"{icons.ICON_FA_XMARK}  {tr(CANCEL)}"
        if running and button(ui, cancel, "export.cancel", tip=tr("stop and leave no file")):
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
        tip = with_keys(tr("training goes on"), "file.export")
        start = f"{icons.ICON_FA_FILM}  {tr('Export {path}').format(path=tr(kind.label).lower())}"
        possible = bool(form.file.strip()) and not self._own.problem
        if button(ui, start, "export.start", enabled=possible, tip=tip):
            yield StartFilmExport()
        if self._own.problem:
            hint(ui, tr(self._own.problem), ui.theme.warning)
        else:
            hint(ui, estimate(form, self._own, snapshot.preview_rays_per_second, snapshot.frame_share))
        yield from _models(ui, state)


def estimate(form: FilmForm, own: Automatic, speed: float, share: float) -> str:
    """Describe the video, and estimate its time from the measured speed of drawing in rays per second.

    share: the export's share of the time while training goes on.
    """
    frames, width, height = form.frames or own.frames, form.width or own.width, form.height or own.height
    film = tr(
        phrases(
            "{n:,} frame of {width:,} × {height:,}, {seconds:.1f} s of video",
            "{n:,} frames of {width:,} × {height:,}, {seconds:.1f} s of video",
            frames,
            width=width,
            height=height,
            seconds=frames / form.fps,
        )
    )
    if speed <= 0:
        return tr("{film}; the time it takes is not measured yet").format(film=film)
    alone = frames * width * height / speed
    text = tr("{film}; takes about {alone}, while training up to {training}")
    return text.format(film=film, alone=tr(duration(alone)), training=tr(duration(alone / share)))


def _form(ui: Ui, form: FilmForm, kind: type[CameraPath], own: Automatic) -> None:
    longest = max((tr(label) for label in (*LABELS, *kind.options)), key=len)
    if imgui.begin_table("form", 2, imgui.TableFlags_.sizing_stretch_same | imgui.TableFlags_.no_pad_outer_x):
        # A kind without a number of its own takes it from the scene, which has no more.
        most = own.frames if kind.default_frames is None else MAX_FRAMES
        text = shown(form.frames, ",") if form.frames else _auto(figure(own.frames, ","))
        tip = tr("0: as many as the path has")
        form.frames = round(_number(ui, "frames", form.frames, (0, most), text, longest, tip)[1])
        form.fps = _number(ui, "fps", form.fps, (1, MAX_FPS), shown(form.fps, HELD), longest)[1]
        for name, option in kind.options.items():
            _option(ui, form, name, option, own.options[name], longest)
        for side, photos in (("width", own.width), ("height", own.height)):
            value: int = getattr(form, side)
            text = tr("{n} px").format(n=figure(value, ",")) if value else _auto(figure(photos, ","))
            tip = tr("0: as the photos were taken")
            setattr(form, side, round(_number(ui, side, value, (0, MAX_SIDE), text, longest, tip)[1]))
        imgui.end_table()
    png = tr(PNG)
    field_beside(ui, png, "")  # a box is at most as wide as an empty button
    _, form.file = imgui.input_text_with_hint("##file", "film.mp4", form.file)
    ui.mark("export.file")
    same_line_if_fits(f"    {png}")
    _, form.png_frames = imgui.checkbox(f"{png}##png", form.png_frames)
    ui.mark("export.png")
    imgui.set_item_tooltip(tr("also write every frame as a PNG, in a folder beside the video"))


def _kind(ui: Ui, form: FilmForm) -> None:
    """The box for the kind of path, if there is more than one."""
    names = list(PATHS.names())
    if len(names) < 2:
        return
    field_width(ui, tr("path"))
    at = names.index(form.path) if form.path in names else 0
    changed, at = imgui.combo(f"{tr('path')}###path", at, [tr(PATHS.get(name).label) for name in names])
    ui.mark("export.path")
    if changed:
        form.path, form.frames, form.options = names[at], 0, {}  # another kind has other numbers


def _option(ui: Ui, form: FilmForm, name: str, option: Option, default: float, longest: str) -> None:
    """A field for an option of this kind of path. A right click goes back to the default."""
    auto = _auto(f"{tr(number(default, 3))}{option.unit}")
    value, limits = form.options.get(name, default), (option.least, option.most)
    text = shown(value, HELD, after=option.unit) if name in form.options else auto.replace("%", "%%")
    tip = tr("right click: {auto}").format(auto=auto)
    changed, value = _number(ui, name, value, limits, text, longest, tip)
    if changed:
        form.options[name] = value
    if imgui.is_item_clicked(imgui.MouseButton_.right):
        form.options.pop(name, None)


def _auto(value: str) -> str:
    return tr("auto, {value}").format(value=value)


def _models(ui: Ui, state: AppState) -> Iterator[Action]:
    """The field and the button for model files, if any kind of them is registered."""
    kinds = [EXPORTS.get(name) for name in EXPORTS.names()]
    if not kinds:
        return
    imgui.separator()
    write = f"{icons.ICON_FA_CUBE}  {tr(MODEL)}"
    field_beside(ui, write)
    _, state.model_file = imgui.input_text_with_hint("##model", f"model{kinds[0].suffix}", state.model_file)
    ui.mark("export.model_file")
    imgui.same_line()
    tip = "; ".join(f"{kind.suffix}: {tr(kind.summary)}" for kind in kinds)
    if button(ui, write, "export.model", enabled=bool(state.model_file.strip()), tip=tip):
        yield StartExport(ExportModel(Path(state.model_file.strip())))


def _number(
    ui: Ui, label: str, value: float, limits: tuple[float, float], text: str, longest: str, tip: str = ""
) -> tuple[bool, float]:
    """The form's next number field: whether the user changed it, and its number within the limits.

    It can be dragged, or edited after a double click. longest: the longest label, as it is drawn, which sets the width
    of all fields. text: what it shows, as a format: see `shown`.
    """
    low, high = limits
    imgui.table_next_column()
    field_width(ui, longest)
    speed = min((high - low) / 1000, 0.5)
    changed, value = imgui.drag_float(
        f"{tr(label)}###export {label}", value, speed, low, high, text, imgui.SliderFlags_.always_clamp
    )
    ui.mark(f"export.{label}")
    if tip:
        imgui.set_item_tooltip(tip)
    return changed, min(max(rounded(value, HELD), low), high)


def _progress(ui: Ui, export: Export) -> None:
    if export.state == "running":
        share = export.done / max(export.total, 1)
        imgui.progress_bar(share, ImVec2(-1, 0), f"{100 * share:.0f} %")
        ui.mark("export.progress")
        text = tr("Exporting {file}: {percent} %")
        if export.seconds_left is not None:
            text = tr("Exporting {file}: {percent} %, {time} left")
        name, percent, left = printable(export.file.name), figure(100 * share, ".0f"), tr(duration(export.seconds_left))
        hint(ui, text.format(file=name, percent=percent, time=left))
    elif export.state == "done":
        hint(ui, tr("Done:"), ui.theme.good)
        path_line(ui, export.file, "export.copy")
    elif export.state == "cancelled":
        hint(ui, tr("Cancelled: nothing was kept."))
    else:
        hint(ui, tr("The export failed and left no file: see Notices."), ui.theme.error)
