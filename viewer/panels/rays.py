"""The rays panel: rename, colour, hide, open and remove pinned rays."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import marked, phrase, tr
from nerf_core.common.text import number, triple
from nerf_core.live.messages import MOST_PINS, PIN_NAME_LENGTH, EditPin, ExportRays, Pin, PinRay, UnpinRay

from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Row, button, field_beside, figures, hint, packed, swatch

WRITE, PIN = marked("Write"), marked("Pin the opened ray")


@PANELS.register("rays")
class RaysPanel:
    title = marked("Rays")
    dock: Literal["right"] = "right"
    order = 4

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        asked, pins = state.inspect, state.snapshot.pins
        there = asked is not None and any(pin.id == asked.id for pin in pins)
        can = asked is not None and not there and len(pins) < MOST_PINS
        tip = tr("keep this ray open, and its history from now on (Ctrl+click in the viewport)")
        if button(ui, f"{icons.ICON_FA_THUMBTACK}  {tr(PIN)}", "rays.pin", enabled=can, tip=tip) and asked is not None:
            yield PinRay.of(asked)
        if not pins:
            text = tr("Up to {n} rays stay where they are while you move, and keep a history of their training.")
            hint(ui, text.format(n=MOST_PINS))
        if pins or state.snapshot.opened is not None:
            write = f"{icons.ICON_FA_FILE_EXPORT}  {tr(WRITE)}"
            field_beside(ui, write)
            _, state.rays_file = imgui.input_text("##file", state.rays_file)
            ui.mark("rays.file")
            imgui.same_line()
            tip = tr("the opened ray and the pinned ones: .json, .npz, .csv, or a figure as .png or .svg")
            if button(ui, write, "rays.write", enabled=bool(state.rays_file.strip()), tip=tip):
                yield ExportRays(Path(state.rays_file.strip()), state.axis)
        for pin in reversed(pins):  # the newest is at the top: the demo scene's own pins fill the panel
            imgui.push_id(pin.id)
            yield from _draw_pin(ui, pin)
            imgui.pop_id()


def _draw_pin(ui: Ui, pin: Pin) -> Iterator[Action]:
    at, high = imgui.get_cursor_screen_pos(), imgui.get_frame_height()
    color = packed(ui.theme.pins[pin.color])
    imgui.get_window_draw_list().add_rect_filled(at, ImVec2(at.x + 0.3 * ui.em, at.y + high), color)
    imgui.dummy(ImVec2(0.3 * ui.em, high))
    imgui.same_line()
    eye = icons.ICON_FA_EYE_SLASH if pin.hidden else icons.ICON_FA_EYE
    field_beside(ui, eye, icons.ICON_FA_MAGNIFYING_GLASS, icons.ICON_FA_XMARK)
    changed, name = imgui.input_text("##name", pin.name)
    ui.mark(f"rays.name {pin.id}")
    if changed:
        yield EditPin(pin.id, name=name[:PIN_NAME_LENGTH])
    imgui.same_line()
    tip = tr("show in the viewport") if pin.hidden else tr("hide in the viewport")
    if button(ui, eye, f"rays.hide {pin.id}", tip=tip):
        yield EditPin(pin.id, hidden=not pin.hidden)
    imgui.same_line()
    if button(ui, icons.ICON_FA_MAGNIFYING_GLASS, f"rays.open {pin.id}", tip=tr("open this ray in the panels")):
        yield pin.inspect()
    imgui.same_line()
    if button(ui, icons.ICON_FA_XMARK, f"rays.remove {pin.id}", tip=tr("remove it and its history")):
        yield UnpinRay(pin.id)
    ray = pin.ray
    if ray is not None:
        depth = ray.depth_median if ray.passes else ray.depth_expected
        rows: list[Row] = [
            (tr("colour"), triple(ray.color), partial(swatch, ui, ray.color)),
            (
                tr("depth"),
                phrase(
                    "{depth}   opacity {opacity:.3f}   step {step:,}",
                    depth=number(depth, 4),
                    opacity=ray.opacity,
                    step=ray.step,
                ),
            ),
        ]
        figures(ui, "figures", rows)
