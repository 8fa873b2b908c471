"""An orbit as a video: what it will be, how long it takes, how far it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.geometry.paths.steps import capture_distance, training_size
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import CancelExport, Export

from ..commands.registry import with_keys
from ..model.state import Action, AppState, OrbitForm, StartOrbitExport
from ..ui.contract import PANELS, Ui
from ..ui.text import duration, number
from ..ui.widgets import button, field_beside, field_width, hint, path_line, same_line_if_fits

START, CANCEL = f"{icons.ICON_FA_FILM}  Export orbit", f"{icons.ICON_FA_XMARK}  Cancel"
MAX_FRAMES, MAX_FPS, MAX_SIDE, MAX_RADIUS = 10_000, 240, 8192, 1e4
PNG = "PNG frames"
LONGEST = "elevation"  # of the labels: all fields end where it starts


@dataclass(frozen=True)
class OwnPath:
    """An orbit as it is by itself, in pixels and scene units; found once, as there may be thousands of photos."""

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
        snapshot, form = state.snapshot, state.orbit
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
        hint(ui, estimate(form, self._own, snapshot.preview_rays_per_second, snapshot.wanted_share))
        tip = with_keys("training goes on", "file.export")
        if button(ui, START, "export.start", enabled=bool(form.file.strip()), tip=tip):
            yield StartOrbitExport()


def estimate(form: OrbitForm, own: OwnPath, speed: float, share: float) -> str:
    """What the video will be and how long it takes at the measured speed of drawing, in rays a second.

    While training goes on with its `share`, export and preview take turns in what is left of the time.
    """
    width, height = form.width or own.width, form.height or own.height
    film = f"{form.frames:,} frames of {width:,} × {height:,}, {form.frames / form.fps:.1f} s of video"
    if speed <= 0:
        return f"{film}; the time it takes is not measured yet"
    alone = form.frames * width * height / speed
    return f"{film}; takes about {duration(alone)}, while training up to {duration(2 * alone / (1 - share))}"


def _form(ui: Ui, form: OrbitForm, own: OwnPath) -> None:
    if imgui.begin_table("form", 2, imgui.TableFlags_.sizing_stretch_same | imgui.TableFlags_.no_pad_outer_x):
        form.frames = round(_number(ui, "frames", form.frames, (1, MAX_FRAMES), "%.0f"))
        form.fps = _number(ui, "fps", form.fps, (1, MAX_FPS), "%.4g")
        form.elevation_degrees = _number(ui, "elevation", form.elevation_degrees, (-90, 90), "%.1f°")
        radius = "%.4g" if form.radius else f"auto, {number(own.radius, 3)}"
        form.radius = _number(ui, "radius", form.radius, (0, MAX_RADIUS), radius)
        for side, photos in (("width", own.width), ("height", own.height)):
            value: int = getattr(form, side)
            shown = "%.0f px" if value else f"auto, {photos:,}"
            setattr(form, side, round(_number(ui, side, value, (0, MAX_SIDE), shown)))
        imgui.end_table()
    field_beside(ui, PNG, "")  # the box is as wide as an empty button is, or less
    _, form.file = imgui.input_text_with_hint("##file", "orbit.mp4", form.file)
    ui.mark("export.file")
    same_line_if_fits(f"    {PNG}")
    _, form.png_frames = imgui.checkbox(PNG, form.png_frames)
    ui.mark("export.png")
    imgui.set_item_tooltip("also write every frame as a PNG, in a folder beside the video")


def _number(ui: Ui, label: str, value: float, limits: tuple[float, float], shown: str) -> float:
    """The form's next field: to drag, or to type into after a double click."""
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
