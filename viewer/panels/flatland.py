"""The page "Flatland": a flat world that is learnt from one-dimensional photos, with one ray and all its samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, tr
from nerf_core.lab.flatland.view import FlatView
from nerf_core.lab.records import Knob, StudyState
from nerf_core.live.messages import TurnKnob

from ..draw.flat_map import Chosen, FlatMap
from ..draw.flat_photos import FlatPhotos, strips_height
from ..draw.flat_plots import psnr_plot, ray_plots
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.study_page import StudyPage
from ..ui.widgets import hint, mono, rounded, same_line_for, shown, swatch

STUDY = "flatland"
CAMERA, PIXEL = "camera", "pixel"  # the knobs that choose a ray
# By knob: the study's option, the slider's label and its tooltip.
SLIDERS: dict[str, tuple[str, str, str]] = {
    "L": ("frequencies", "L", marked("frequencies of the position's encoding; 0: bare coordinates. Begins anew.")),
    "coarse": ("coarse", "N_c", marked("coarse samples of a ray, evenly spaced")),
    "fine": ("fine", "N_f", marked("fine samples, drawn from the coarse weights; 0: no hierarchy")),
    "cameras": ("cameras", marked("cameras"), marked("cameras that take the training photos. Begins anew.")),
    "noise": ("noise", marked("noise"), marked("standard deviation of the noise in the photos. Begins anew.")),
    "directions": (
        "directions",
        marked("view"),
        marked("frequencies of the direction's encoding; 0: colours are the same from all sides. Begins anew."),
    ),
}
SLIDER_EM = 4.6, 6.5  # least and largest width
WIDE_EM, TALL_EM = 36.0, 10.0  # room from which plots lie beside the map, and the map's least side
COLUMN_EM = 13.0, 20.0  # least and largest width of the photos' column
RAY_EM = 15.0, 12.0  # least width of the ray's plots beside the map, and their height below it
CURVE_EM, CURVE_SHARE = 3.0, 0.22  # least height of the curve, and its share of the column
LETTERS = 3  # of a symbol at most; longer labels are words, and need no sign before their number
LESSON_EM = 22.0  # height of the page from which the lesson stands in it
BEFORE = marked(
    "A world of two dimensions, whose photos are lines. A small network learns it from a ring of cameras, as the paper "
    "learns a scene: by Eq. 3 to 6. Start, and watch the whole field form out of fog."
)
LESSON = marked(
    "Point at a camera, a photo's pixel or the field: its ray is opened. Circles are coarse samples, dots fine ones, "
    "bars weights. Try few cameras, noise, L = 0, L = 8, or no fine samples. A click holds the ray."
)


@PANELS.register("flatland")
class FlatlandPanel:
    title = marked("Flatland")
    dock: Literal["bottom"] = "bottom"
    order = 7

    def __init__(self) -> None:
        self._map, self._world, self._photos = FlatMap(), FlatMap(), FlatPhotos()
        self._page = StudyPage(STUDY, "flatland", {name: option for name, (option, _, _) in SLIDERS.items()})
        self._chosen = Chosen(0, None)
        self._held = False  # the ray stays where it is
        self._sent: tuple[int, int] | None = None  # the ray that the worker was last asked for
        self._truth = False  # where there is room for one picture, it is the world's
        self._newest: tuple[Path, str] | None = None  # the study that was asked for it, and its state

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot = state.snapshot
        if snapshot.status == "loading" and not snapshot.loaded:
            hint(ui, tr("A flat world that takes shape in seconds: it appears when PyTorch is loaded."))
            return
        study = self._page.look(snapshot)
        newest = (study.folder, study.state) if study is not None else None
        if newest != self._newest:
            self._newest, self._sent = newest, None  # this one has not been asked
        yield from self._toolbar(ui)
        imgui.begin_child("page", ImVec2(0, 0))
        self._page.remarks(ui)
        if study is None or study.flat is None:
            hint(ui, tr(BEFORE))
        else:
            yield from self._learning(ui, study, study.flat)
        imgui.end_child()

    # ---- above --------------------------------------------------------------------------------------------------

    def _toolbar(self, ui: Ui) -> Iterator[Action]:
        yield from self._page.buttons(ui)
        knobs = {knob.name: knob for knob in self._page.knobs()}
        gap, padding = 0.4 * ui.em, imgui.get_style().window_padding.x
        room = imgui.get_window_pos().x + imgui.get_window_width() - padding - imgui.get_item_rect_max().x
        wide = min(max(room / len(SLIDERS) - gap, SLIDER_EM[0] * ui.em), SLIDER_EM[1] * ui.em)
        for name in SLIDERS:
            if name in knobs:
                same_line_for(float(int(wide)), gap)
                imgui.set_next_item_width(float(int(wide)))
                yield from self._slider(ui, knobs[name], tr(SLIDERS[name][1]))

    def _slider(self, ui: Ui, knob: Knob, label: str) -> Iterator[Action]:
        """Draw a slider, which turns its knob when it is let go: most knobs begin anew."""
        name, page = knob.name, self._page
        value = page.values.get(name, knob.value)
        sign = " = " if len(label) <= LETTERS else " "
        spec = ".2f" if name == "noise" else ".0f"
        text = shown(value, spec, before=f"{label}{sign}")
        if name == "noise":
            changed, number = imgui.slider_float(f"##flatland.{name}", value, knob.least, knob.most, text)
        else:
            ends = round(knob.least), round(knob.most)
            changed, number = imgui.slider_int(f"##flatland.{name}", round(value), *ends, text)
        ui.mark(f"flatland.{name}")
        active, ended = imgui.is_item_active(), imgui.is_item_deactivated_after_edit()
        imgui.set_item_tooltip(tr(SLIDERS[name][2]))
        if changed:
            value = page.values[name] = rounded(number, spec)
        if ended and page.running:
            yield TurnKnob(name, value)
        elif ended:
            yield from page.let_go(knob, value)
        page.settle(knob, dragged=active or changed)

    # ---- below --------------------------------------------------------------------------------------------------

    def _learning(self, ui: Ui, study: StudyState, view: FlatView) -> Iterator[Action]:
        over = self._laid_out(ui, study, view)
        if over is not None and study.state != "running":
            imgui.set_tooltip(tr("Start or go on, to open other rays."))
        if over is not None:
            if imgui.is_mouse_clicked(imgui.MouseButton_.left):
                self._held = not self._held
            if not self._held:
                self._chosen = Chosen(over.camera, self._pixel(view) if over.pixel is None else over.pixel)
        if study.state == "running":
            self._chosen = Chosen(min(self._chosen.camera, len(view.cameras) - 1), self._pixel(view))
            wanted = self._chosen.camera, self._pixel(view)
            if wanted != self._sent:
                before, self._sent = self._sent or (-1, -1), wanted
                for name, old, new in zip((CAMERA, PIXEL), before, wanted, strict=True):
                    if old != new:
                        yield TurnKnob(name, float(new))

    def _laid_out(self, ui: Ui, study: StudyState, view: FlatView) -> Chosen | None:
        """Draw the page. Returns what the mouse is over."""
        if imgui.get_content_region_avail().y > LESSON_EM * ui.em:
            hint(ui, tr(LESSON))
        room, gap = imgui.get_content_region_avail(), 0.8 * ui.em
        wide = room.x > WIDE_EM * ui.em
        column = min(max(0.28 * room.x, COLUMN_EM[0] * ui.em), COLUMN_EM[1] * ui.em)
        tall = room.y - imgui.get_text_line_height_with_spacing()
        below = wide and room.x - column - tall - 2 * gap < RAY_EM[0] * ui.em and tall > 2.5 * RAY_EM[1] * ui.em
        if below:  # a high page: the ray's plots lie under the map
            most = min(tall - RAY_EM[1] * ui.em, room.x - column - gap)
        elif wide:
            most = min(tall, room.x - column - 2 * gap - RAY_EM[0] * ui.em)
        else:
            most = min(tall, room.x)
        side = float(int(max(most, TALL_EM * ui.em)))
        two = not below and room.x > 2 * side + 2 * column + 3 * gap
        imgui.begin_group()
        over = self._maps(ui, view, side, two)
        if wide and not below:
            imgui.same_line(0, gap)
        if wide:
            left = room.x - column - gap if below else imgui.get_content_region_avail().x - column - gap
            high = imgui.get_content_region_avail().y if below else max(room.y, side)
            imgui.begin_child("ray", ImVec2(max(left, ui.em), max(high, ui.em)))
        self._ray(ui, view)
        if wide:
            imgui.end_child()
        imgui.end_group()
        if wide:
            imgui.same_line(0, gap)
            imgui.begin_child("photos", ImVec2(0, max(room.y, side)))
        over = self._strips(ui, study, view, wide) or over
        if wide:
            imgui.end_child()
        return over

    def _pixel(self, view: FlatView) -> int:
        wide = view.photos.shape[1]
        return wide // 2 if self._chosen.pixel is None else min(self._chosen.pixel, wide - 1)

    def _maps(self, ui: Ui, view: FlatView, side: float, two: bool) -> Chosen | None:
        """Draw the learnt field and the world, side by side or one of them."""
        camera = self._chosen.camera
        shown = ((False, tr("learnt")), (True, tr("the world")))
        imgui.begin_group()
        for truth, name in shown[: 1 if two else 2]:
            if truth:
                imgui.same_line(0, ui.em)
            imgui.text_colored(ui.theme.text if two or truth == self._truth else ui.theme.muted, name)
            ui.mark(f"flatland.show.{'world' if truth else 'learnt'}")
            if imgui.is_item_clicked():
                self._truth = truth
            if not two and imgui.is_item_hovered():
                imgui.set_mouse_cursor(imgui.MouseCursor_.hand)
        over = self._map.draw(ui, view, side, two or not self._truth, "flatland.field", camera)
        imgui.end_group()
        if two:
            imgui.same_line(0, 0.8 * ui.em)
            imgui.begin_group()
            imgui.text_unformatted(shown[1][1])
            over = self._world.draw(ui, view, side, False, "flatland.world", camera) or over
            imgui.end_group()
        return over

    def _ray(self, ui: Ui, view: FlatView) -> None:
        """Draw the chosen ray's numbers and plots."""
        ray = view.ray
        if ray is None:
            return
        kind = tr("camera {n}") if ray.camera < view.training else tr("held-out camera {n}")
        imgui.text_unformatted(kind.format(n=ray.camera + 1) + ", " + tr("pixel {n}").format(n=ray.pixel + 1))
        ui.mark("flatland.ray")
        if self._held:
            imgui.same_line(0, 0.4 * ui.em)
            imgui.text_colored(ui.theme.ray, icons.ICON_FA_LOCK)
            imgui.set_item_tooltip(tr("The ray is held: another click lets it follow the mouse."))
        for label, color in ((tr("learnt"), ray.passes[-1].color), (tr("world"), ray.truth)):
            same_line_for(imgui.calc_text_size(label).x + 1.3 * ui.em, 0.6 * ui.em)
            swatch(ui, color)
            imgui.same_line(0, 0.25 * ui.em)
            imgui.text_colored(ui.theme.muted, label)
        room = imgui.get_content_region_avail()
        ray_plots(ui, ray, ImVec2(max(room.x, ui.em), max(room.y, 0.8 * TALL_EM * ui.em)))

    def _strips(self, ui: Ui, study: StudyState, view: FlatView, wide: bool) -> Chosen | None:
        """Draw all photos, how far training is, and the curve."""
        line = imgui.get_text_line_height_with_spacing()
        imgui.text_colored(ui.theme.muted, tr("photos: true, and learnt below"))
        imgui.set_item_tooltip(tr("a line of pixels of each camera, in their order on the ring; hollow: held out"))
        room = imgui.get_content_region_avail()
        spacing = imgui.get_style().item_spacing.y
        least = max(CURVE_EM * ui.em, CURVE_SHARE * room.y) if wide else 2 * CURVE_EM * ui.em
        high = strips_height(ui, view, (room.y if wide else 0.0) - line - least - spacing)
        over = self._photos.draw(ui, view, (max(room.x, ui.em), high), Chosen(self._chosen.camera, self._pixel(view)))
        words = [tr("step {step}").format(step=figure(view.step, ",d"))]
        words += [tr("{psnr} dB").format(psnr=figure(view.psnr, ".1f"))] if np.isfinite(view.psnr) else []
        if study.state == "running":
            words.append(tr("{n} steps/s").format(n=figure(view.steps_per_second, ".0f")))
        with mono(ui):
            whole = "  ".join(words)
            imgui.text_unformatted(whole if imgui.calc_text_size(whole).x <= room.x else "  ".join(words[:2]))
        ui.mark("flatland.progress")
        left = imgui.get_content_region_avail()
        psnr_plot(ui, study.curves, ImVec2(max(left.x, ui.em), max(left.y, least) if wide else least))
        return over
