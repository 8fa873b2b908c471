"""The view panel: the camera, the render mode, how sharp the preview is, and what is drawn over it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from imgui_bundle import ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, phrase, tr
from nerf_core.common.text import number, vector
from nerf_core.rendering.modes import COLOR, MODES, mode_names, obstacle

from ..commands.registry import USER_COMMANDS, run, with_keys
from ..draw.warp import same_view
from ..model.state import Action, AppState, FocusOn
from ..ui.contract import PANELS, Ui
from ..ui.widgets import STALE, Row, button, field_width, figures, hint, same_line_if_fits

FRAME, FOCUS = marked("Frame"), marked("Focus")


@PANELS.register("view")
class ViewPanel:
    title = marked("View")
    dock: Literal["right"] = "right"
    order = 2

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        control, point = state.camera, _point(state)
        text, color = _preview_state(ui, state)
        hint(ui, text, color)
        rows: list[Row] = [
            (tr("position"), vector(control.c2w()[:, 3])),
            (tr("pivot"), vector(control.pivot)),
            (tr("distance"), phrase("{distance} units", distance=number(control.distance))),
            (tr("field of view"), phrase("{angle:.1f}° vertical", angle=control.fov_y_degrees)),
            (tr("picture"), phrase("{width:,} × {height:,} px", width=state.viewport[0], height=state.viewport[1])),
        ]
        figures(ui, "view", rows)
        opened = state.snapshot.scene is not None
        frame, tip = f"{icons.ICON_FA_EXPAND}  {tr(FRAME)}", with_keys(tr("see the whole scene"), "camera.frame")
        if button(ui, frame, "view.frame", enabled=opened, tip=tip):
            yield from run("camera.frame", state)
        reset = _titled(icons.ICON_FA_HOUSE, "camera.reset")
        same_line_if_fits(reset)
        tip = with_keys(tr("back to where the scene was first seen from"), "camera.reset")
        if button(ui, reset, "view.reset", enabled=opened, tip=tip):
            yield from run("camera.reset", state)
        focus = f"{icons.ICON_FA_CROSSHAIRS}  {tr(FOCUS)}"
        same_line_if_fits(focus)
        tip = tr("orbit the point of the opened ray; in the viewport: double click")
        if button(ui, focus, "view.focus", enabled=point is not None, tip=tip) and point is not None:
            yield FocusOn(point)
        _modes(ui, state)
        rays, cameras = tr(USER_COMMANDS.get("show.ray").title), tr(USER_COMMANDS.get("show.cameras").title)
        _, state.show_samples = imgui.checkbox(f"{rays}###rays", state.show_samples)
        ui.mark("view.samples")
        same_line_if_fits(f"     {cameras}")
        _, state.show_cameras = imgui.checkbox(f"{cameras}###cameras", state.show_cameras)
        ui.mark("view.cameras")
        help_ = _titled(icons.ICON_FA_KEYBOARD, "show.help")
        same_line_if_fits(help_)
        if button(ui, help_, "view.help", tip=with_keys(tr("what mouse and keys do"), "show.help")):
            yield from run("show.help", state)


def _point(state: AppState) -> np.ndarray | None:
    """The opened ray's point (3,): that of the radiance, or where a ray without samples ends; None: there is none."""
    radiance, ray = state.snapshot.radiance, state.snapshot.ray
    if radiance is not None:
        return radiance.point
    if ray is None or ray.passes or ray.depth_expected is None:
        return None
    return ray.origin.astype(np.float64) + ray.depth_expected * ray.direction.astype(np.float64)


def _titled(icon: str, command: str) -> str:
    """A button's label: an icon, and the name that the menus and the palette have for this command."""
    return f"{icon}  {tr(USER_COMMANDS.get(command).title)}"


def _modes(ui: Ui, state: AppState) -> None:
    """The choice of the render mode."""
    labels = {name: tr("Colour") if name == COLOR else tr(MODES.get(name).label) for name in mode_names()}
    field_width(ui, tr("shows"))
    if imgui.begin_combo(f"{tr('shows')}###shows", labels.get(state.mode, "")):
        for name, label in labels.items():
            lacks = obstacle(state.snapshot.method, name)
            flags = imgui.SelectableFlags_.disabled if lacks else imgui.SelectableFlags_.none
            chosen, _ = imgui.selectable(f"{label}###mode {name}", name == state.mode, flags)
            ui.mark(f"view.mode.{name}")
            _mode_tip(name, lacks)
            if chosen:
                state.mode = name
        imgui.end_combo()
    ui.mark("view.mode")
    _mode_tip(state.mode, "")


def _mode_tip(name: str, lacks: str) -> None:
    """The last item's tooltip: what a mode shows, or why it cannot be shown."""
    tip = tr(lacks) or ("" if name == COLOR else tr(MODES.get(name).tip))
    if tip and imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled | imgui.HoveredFlags_.for_tooltip):
        imgui.set_tooltip(tip)


def _preview_state(ui: Ui, state: AppState) -> tuple[str, ImVec4]:
    """A text about the picture in the viewport: its resolution and step."""
    preview, muted = state.snapshot.preview, ui.theme.muted
    if state.snapshot.scene is None or preview is None:
        return tr("No picture yet."), muted
    if not same_view(preview.camera, state.camera.camera(*state.viewport)):
        return f"{tr(STALE)}.", ui.theme.warning
    coarse = state.snapshot.coarse
    current = preview.complete and preview.step == state.snapshot.step
    shown = tr("Full resolution")
    if preview.stride > 1 and not current:
        shown = tr("1/{stride} resolution").format(stride=preview.stride)
    if preview.quality == "coarse" and coarse:
        shown = f"{shown}, {tr(coarse)}"
    if current:
        return shown, ui.theme.good
    text = tr("{picture}, as of step {step}: sharpening")
    if preview.complete:
        text = tr("{picture}, as of step {step}: refreshing")
    return text.format(picture=shown, step=figure(preview.step, ",")), muted
