"""The page about positional encoding: four networks learn a picture, and the reader turns what tells them apart."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import figure, marked, tr
from nerf_core.common.text import NOTHING, duration
from nerf_core.lab.records import Curve, Knob, StudyState
from nerf_core.live.messages import TurnKnob

from ..draw.encoding_pictures import GAP_EM, LINE_EM, PictureRow, Shown
from ..draw.encoding_waves import WavePlot, bar_code
from ..draw.paint_canvas import SIDE
from ..model.state import Action, AppState
from ..ui.axes import fitted_axes
from ..ui.contract import PANELS, Ui
from ..ui.study_page import StudyPage
from ..ui.widgets import button, hint, mono, rounded, same_line_for, shown
from .encoding_source import Source

STUDY = "image"
L, SIGMA = "L", "σ"  # its knobs
OPTIONS = {L: "frequencies", SIGMA: "sigma"}  # by knob: the study's option
NAMES = ("none", "basic", "positional", "gaussian")  # its networks
VIEWS = ("pictures", "spectra", "draw")
SLIDER_EM = 5.5, 3.4  # width, and that in a narrow page
NARROW_EM = 30.0
WIDE_EM, SIDE_EM = 60.0, 21.0  # the page's width from which plots lie beside the pictures, and their least width
PICTURE_EM = 3.0, 22.0  # least and largest width of a picture
BOTH_EM = 8.5  # height of a picture from which spectra lie under the pictures
PLOTS_EM = 13.0  # height of the plots under the pictures
SIGMA_SPEC = ".3g"  # as its slider shows it
STEP = 1.05  # a slider that is dragged sends σ whenever it has changed by this factor
LESSON = marked(
    "Bare coordinates learn a blur: a network learns low frequencies first (spectral bias). With L too small the "
    "picture stays blurred; with L too large the network fits noise between the training pixels."
)
BEFORE = marked(
    "Four networks learn this picture, pixel by pixel: from (x, y) the colour. They differ only in how the coordinates "
    "are encoded. Start, or draw a picture of your own."
)
PLOT = implot.Flags_.no_title | implot.Flags_.no_menus | implot.Flags_.no_mouse_text | implot.Flags_.no_legend


@PANELS.register("encoding")
class EncodingPanel:
    title = marked("Encoding")
    dock: Literal["bottom"] = "bottom"
    order = 6

    def __init__(self) -> None:
        self._view = "pictures"
        self._page = StudyPage(STUDY, "encoding", OPTIONS)
        self._source = Source(self._page.folders)
        self._pictures, self._waves = PictureRow(), WavePlot()
        self._sent: dict[str, float] = {}  # turns that the worker has not yet obeyed

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot, page = state.snapshot, self._page
        if snapshot.status == "loading" and not snapshot.loaded:
            hint(ui, tr("Networks that learn a picture: they appear when PyTorch is loaded."))
            return
        study, begun = page.look(snapshot), page.begun
        page.photo = self._source.photo
        self._pictures.top = imgui.get_window_pos().y
        narrow = imgui.get_window_width() < NARROW_EM * ui.em
        if not narrow:
            yield from self._toolbar(ui, study)
        imgui.begin_child("page", ImVec2(0, 0))
        if narrow:  # where the buttons take several lines, they scroll with the page
            yield from self._toolbar(ui, study)
        page.remarks(ui)
        if self._view == "draw":
            if self._source.draw(ui, page.obstacle):
                page.photo = self._source.photo
                yield from page.begin()
        else:
            self._learning(ui, study)
        imgui.end_child()
        if page.begun is not begun and self._view == "draw":
            self._view = "pictures"

    # ---- above --------------------------------------------------------------------------------------------------

    def _toolbar(self, ui: Ui, study: StudyState | None) -> Iterator[Action]:
        yield from self._page.buttons(ui)
        slider = SLIDER_EM[imgui.get_window_width() < NARROW_EM * ui.em] * ui.em
        for knob in self._page.knobs():
            same_line_for(slider + 1.2 * ui.em, 0.7 * ui.em)
            imgui.set_next_item_width(slider)
            yield from self._slider(ui, knob)
        names = {"pictures": tr("Pictures"), "spectra": tr("Spectra"), "draw": tr("Draw…")}
        for k, view in enumerate(VIEWS):
            same_line_for(_button_width(names[view]), (0.25 if k else 0.7) * ui.em)
            chosen = self._view == view
            if chosen:
                imgui.push_style_color(imgui.Col_.button, imgui.get_style().color_(imgui.Col_.button_active))
            tip = tr("Draw or open a picture of your own, and let the networks learn it.") if view == "draw" else ""
            if button(ui, names[view], f"encoding.view.{view}", tip=tip):
                self._view = view
            if chosen:
                imgui.pop_style_color()
        if study is not None and self._page.running:
            percent = f"{figure(100 * study.fraction, '.0f')} %"
            same_line_for(imgui.calc_text_size(percent).x, 0.7 * ui.em)
            with mono(ui):
                imgui.align_text_to_frame_padding()
                imgui.text_colored(ui.theme.accent, percent)
            ui.mark("encoding.progress")
            if study.seconds_left is not None:
                imgui.set_item_tooltip(tr("{time} left").format(time=tr(duration(study.seconds_left))))

    def _slider(self, ui: Ui, knob: Knob) -> Iterator[Action]:
        """Draw a slider that turns its knob while it is dragged: L at every number, σ every few percent.

        A study that has ended begins again when it is let go.
        """
        name, page = knob.name, self._page
        value = page.values.get(name, knob.value)
        label = f"{name}##encoding.{name}"
        if name == L:
            changed, number = imgui.slider_int(label, round(value), round(knob.least), round(knob.most))
        else:
            flags = imgui.SliderFlags_.logarithmic
            changed, number = imgui.slider_float(label, value, knob.least, knob.most, shown(value, SIGMA_SPEC), flags)
        ui.mark(f"encoding.{name}")
        if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip):
            imgui.set_tooltip(
                tr("number of frequencies 1, 2, 4, … of the positional encoding")
                if name == L
                else tr("deviation of the Gaussian encoding's frequencies, in cycles per picture")
            )
        if changed:
            value = page.values[name] = rounded(number, SIGMA_SPEC)
        sent = self._sent.get(name, knob.value)
        ended = imgui.is_item_deactivated_after_edit()
        far = value != sent if name == L else abs(math.log(value / sent)) > math.log(STEP)
        if not page.running or knob.value == sent:
            self._sent.pop(name, None)  # the worker has obeyed
        if page.running and ((changed and far) or (ended and value != sent)):
            self._sent[name] = value
            yield TurnKnob(name, value)
        elif ended:
            yield from page.let_go(knob, value)
        page.settle(knob, dragged=imgui.is_item_active() or changed or name in self._sent)

    # ---- pictures and plots -------------------------------------------------------------------------------------

    def _learning(self, ui: Ui, study: StudyState | None) -> None:
        room = imgui.get_content_region_avail()
        wide = room.x > WIDE_EM * ui.em
        curves = {curve.name: curve for curve in study.curves} if study is not None else {}
        rows = self._rows(ui, study, curves)
        target = rows["pictures"][0].image
        shape = target.shape[:2] if target is not None else (SIDE, SIDE)
        lesson = tr(BEFORE if study is None else LESSON)
        size, both = _picture_size(ui, room, shape, wide, lesson)
        across = len(NAMES) + 1
        grid = across * size[0] + (across - 1) * GAP_EM * ui.em
        imgui.begin_child("pictures", ImVec2(grid if wide else 0, 0), imgui.ChildFlags_.auto_resize_y)
        if both or self._view == "pictures":
            self._pictures.draw(ui, rows["pictures"], size, lambda pixel: self._numbers(ui, pixel, shape))
        if both:
            self._pictures.draw(ui, rows["spectra"], size, captions=False)
        elif self._view == "spectra":
            self._pictures.draw(ui, rows["spectra"], size)
        hint(ui, lesson)
        imgui.end_child()
        pixel = self._pictures.pixel or (shape[1] // 2, shape[0] // 2)
        count = round(self._page.wanted().get(L, 4))
        if wide:
            imgui.same_line(0, ui.em)
            imgui.begin_child("plots", ImVec2(0, 0))
            room = imgui.get_content_region_avail()
            if curves:
                _curves(ui, curves, room.y * 0.45)
            left = imgui.get_content_region_avail().y
            self._waves.draw(ui, count, pixel, max(shape), min(left, 26 * ui.em))
            imgui.end_child()
            return
        half = (room.x - ui.em) / 2 if curves and room.x > 2 * PLOTS_EM * ui.em else 0.0
        high = PLOTS_EM * ui.em
        imgui.begin_child("waves", ImVec2(half, 0), imgui.ChildFlags_.auto_resize_y)
        self._waves.draw(ui, count, pixel, max(shape), high)
        imgui.end_child()
        if curves:
            if half:
                imgui.same_line(0, ui.em)
            imgui.begin_child("curves", ImVec2(0, high))
            _curves(ui, curves, high)
            imgui.end_child()

    def _rows(self, ui: Ui, study: StudyState | None, curves: Mapping[str, Curve]) -> dict[str, list[Shown]]:
        """Return the pictures and the spectra, the target's first."""
        looks = {look.name: look.image for look in study.looks} if study is not None else {}
        target = looks.get("photo", self._source.preview)
        learnt = self._page.learnt() if study is not None else self._page.wanted()
        count, sigma = str(round(learnt.get(L, 0))), figure(learnt.get(SIGMA, 0), ".3g")
        captions = {
            "none": (tr("(x, y) alone"), "(x, y)"),
            "basic": (tr("basic, L = {n}").format(n="1"), "L = 1"),
            "positional": (tr("positional, L = {n}").format(n=count), f"L = {count}"),
            "gaussian": (tr("Gaussian, σ = {value}").format(value=sigma), f"σ = {sigma}"),
        }
        size = "" if target is None else f"{target.shape[1]} × {target.shape[0]}"
        pictures = [Shown("photo", target, (tr("the picture"), tr("target")), (size, ""))]
        spectra = [Shown("spectrum of photo", looks.get("spectrum of photo"), (tr("its spectrum"), tr("target")))]
        for name, color in zip(NAMES, ui.theme.pins, strict=False):
            curve = curves.get(name)
            reached = float(curve.y[-1]) if curve is not None and len(curve.y) else math.nan
            number = figure(reached, ".1f") if math.isfinite(reached) else NOTHING
            notes = (tr("{psnr} dB").format(psnr=number), number) if math.isfinite(reached) else (number,)
            pictures.append(Shown(name, looks.get(name), captions[name], notes, color))
            spectra.append(Shown(f"spectrum of {name}", looks.get(f"spectrum of {name}"), captions[name], notes, color))
        return {"pictures": pictures, "spectra": spectra}

    def _numbers(self, ui: Ui, pixel: tuple[int, int], shape: tuple[int, ...]) -> None:
        """Draw, under the enlarged parts, the pixel's 4L numbers."""
        count = round(self._page.learnt().get(L, 4))
        text = tr("column {column}, row {row}: {n} numbers of the positional encoding, L = {L}")
        imgui.text_colored(ui.theme.muted, text.format(column=pixel[0], row=pixel[1], n=4 * count, L=count))
        bar_code(ui, count, pixel, max(shape), imgui.get_content_region_avail().x)


def _picture_size(
    ui: Ui, room: ImVec2, shape: tuple[int, ...], wide: bool, lesson: str
) -> tuple[tuple[float, float], bool]:
    """Return the size of each picture, and whether spectra fit under the pictures."""
    across = len(NAMES) + 1
    gaps = (across - 1) * GAP_EM * ui.em
    width = (room.x - (SIDE_EM + 1) * ui.em * wide - gaps) / across
    line, spacing = imgui.get_text_line_height_with_spacing(), imgui.get_style().item_spacing.y
    both = False
    for _ in range(2):  # narrower pictures make the sentence under them longer
        words = imgui.calc_text_size(lesson, wrap_width=max(across * width + gaps if wide else room.x, ui.em)).y
        high = room.y - 2 * line - words - 3 * spacing - 2 * LINE_EM * ui.em  # what captions and the sentence leave
        both = (high - spacing) / 2 >= BOTH_EM * ui.em
        high = (high - spacing) / 2 if both else high
        width = min(max(min(width, high * shape[1] / shape[0]), PICTURE_EM[0] * ui.em), PICTURE_EM[1] * ui.em)
    width = float(int(width))
    return (width, width * shape[0] / shape[1]), both


def _curves(ui: Ui, curves: Mapping[str, Curve], height: float) -> None:
    imgui.text_colored(
        ui.theme.muted, tr("PSNR of held-out pixels (dB) over steps")
    )  # in the plot it would hide curves
    height -= imgui.get_text_line_height_with_spacing()
    implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
    if implot.begin_plot("##psnr", ImVec2(-1, max(height, ui.em)), PLOT):
        fitted_axes([(curve.x, curve.y) for curve in curves.values()])
        for name, color in zip(NAMES, ui.theme.pins, strict=False):
            if name in curves:
                x, y = (values.astype(np.float64) for values in (curves[name].x, curves[name].y))
                implot.plot_line(name, x, y, implot.Spec(line_color=color, line_weight=0.12 * ui.em))
        implot.end_plot()
        ui.mark("encoding.curves")
    implot.pop_style_var()


def _button_width(label: str) -> float:
    return imgui.calc_text_size(label).x + 2 * imgui.get_style().frame_padding.x
