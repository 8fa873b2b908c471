"""The panel "Follow this pixel": the method as a strip of stages with the opened ray's own values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.colormaps import colored
from nerf_core.common.language import figure, marked, tr
from nerf_core.methods.stages import BarCode, Chart, Colors, Marks, Pictures, Stage, Stems, Transfer

from ..draw.picture_stack import picture_stack
from ..model.state import Action, AppState
from ..ui.axes import axis_name, number_ticks
from ..ui.contract import PANELS, Ui
from ..ui.widgets import color_of, faded, figures, hint, nothing_yet, packed, swatch

WIDTH_EM = 19.0
CHART_EM = 2.0, 9.0  # least and largest height of a plot; in between, the plots of a stage share its height
PICTURES_EM, PICTURE_PARTS = (7.0, 16.0), 3  # the same of pictures; how many plots they are as high as
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
QUIET = implot.AxisFlags_.no_highlight


class Space(NamedTuple):
    """The space of a plot.

    high: its height without the numbers of t, in pixels.
    numbered: whether these numbers are below it.
    near, far: the part of the ray that its axis may show.
    """

    high: float
    numbered: bool
    near: float
    far: float

    def limits(self, t: np.ndarray) -> tuple[float, float]:
        """Return the ends of the axis for marks at t.

        In contracted space the last samples may lie thousands of scenes away, where nothing has any weight.
        """
        low, high = (float(t.min()), float(t.max())) if len(t) else (self.near, self.far)
        low, high = max(low, min(self.near, high)), min(high, max(self.far, low))
        margin = 0.03 * max(high - low, 1e-6)  # an axis needs a length, also for a single mark
        return low - margin, high + margin


@PANELS.register("walk")
class WalkPanel:
    title = marked("Follow this pixel")
    dock: Literal["bottom"] = "bottom"
    order = 2

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        yield from ()
        opened = state.snapshot.opened
        if opened is None or not opened.walk:
            nothing_yet(
                ui,
                state.snapshot.method,
                tr("Click a pixel: here you will see it go through the whole method, stage by stage."),
                (),
            )
            return
        scroll = imgui.WindowFlags_.horizontal_scrollbar
        imgui.begin_child("strip", ImVec2(0, 0), 0, scroll)
        wheel = imgui.get_io().mouse_wheel
        if wheel and imgui.is_window_hovered(imgui.HoveredFlags_.child_windows) and not imgui.get_io().key_shift:
            imgui.set_scroll_x(imgui.get_scroll_x() - 4 * ui.em * wheel)  # the strip only scrolls sideways
        high = max(imgui.get_content_region_avail().y, 8 * ui.em)
        for k, stage in enumerate(opened.walk):
            if k:
                imgui.same_line(0, 1.2 * ui.em)
            still = imgui.WindowFlags_.no_scroll_with_mouse
            imgui.begin_child(f"stage {k}", ImVec2(WIDTH_EM * ui.em, high), 0, still)
            _draw_stage(ui, k + 1, stage, (opened.ray.near, opened.ray.far))
            imgui.end_child()
            if k + 1 < len(opened.walk):
                _arrow(ui)
        imgui.end_child()


def _draw_stage(ui: Ui, number: int, stage: Stage, bounds: tuple[float, float]) -> None:
    imgui.text_colored(ui.theme.accent, f"{number}")
    imgui.same_line(0, 0.5 * ui.em)
    imgui.text_unformatted(tr(stage.title))
    ui.mark(f"walk.{stage.title}")
    hint(ui, tr(stage.sentence))
    part, lowest = _plot_height(ui, stage), len(stage.charts) - 1
    for k, chart in enumerate(stage.charts):
        least, most = (em * ui.em for em in (PICTURES_EM if isinstance(chart, Pictures) else CHART_EM))
        high = min(max(_parts(chart) * part - imgui.get_style().item_spacing.y, least), most)
        CHARTS[type(chart)](ui, f"##{number} {k}", chart, Space(high, k == lowest, *bounds))
    if stage.rows:
        figures(ui, "rows", [(tr(label), tr(value)) for label, value in stage.rows])


def _plot_height(ui: Ui, stage: Stage) -> float:
    """The height of a plot with its gap: what the numbers of t and the figures leave, divided by the plots."""
    parts = sum(_parts(chart) for chart in stage.charts)
    if not parts:
        return 0.0
    line, gap = imgui.get_text_line_height_with_spacing(), imgui.get_style().item_spacing.y
    rest = imgui.get_content_region_avail().y - len(stage.rows) * (line + gap) - gap - line
    return rest / parts


def _parts(chart: Chart) -> int:
    """How much of the height a chart gets; 0: it takes what it needs."""
    return PICTURE_PARTS if isinstance(chart, Pictures) else int(isinstance(chart, (Stems, Marks, Transfer)))


def _arrow(ui: Ui) -> None:
    """An arrow between two stages, level with their titles."""
    low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
    x, y, r = high.x + 0.6 * ui.em, low.y + 0.55 * ui.em, 0.3 * ui.em
    tip = ImVec2(x + r, y)
    imgui.get_window_draw_list().add_triangle_filled(
        ImVec2(x - r, y - r), tip, ImVec2(x - r, y + r), packed(ui.theme.muted)
    )


def _begin(ui: Ui, name: str, t: np.ndarray, top: float, space: Space) -> bool:
    pad = 0.25 * ui.em
    implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(0.9 * ui.em, pad))
    implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
    high = space.high + (imgui.get_text_line_height_with_spacing() if space.numbered else 0.0)
    begun = implot.begin_plot(name, ImVec2(-1, high), PLOT)
    implot.pop_style_var(2)
    if begun:
        implot.setup_axis(implot.ImAxis_.x1, None, QUIET | (0 if space.numbered else implot.AxisFlags_.no_tick_labels))
        implot.setup_axis(implot.ImAxis_.y1, None, QUIET | implot.AxisFlags_.no_tick_labels)
        ends = space.limits(t)
        implot.setup_axes_limits(*ends, 0, 1.15 * max(top, 1e-30), implot.Cond_.always)
        number_ticks(implot.ImAxis_.x1, *ends)
    return begun


def _stems(ui: Ui, name: str, chart: Stems, space: Space) -> None:
    t, y = (np.nan_to_num(v.astype(np.float64)) for v in (chart.t, chart.y))
    top = float(y.max()) if len(y) else 1.0
    if _begin(ui, name, t, top, space):
        if len(t):
            implot.plot_stems("stems", t, y, 0, implot.Spec(line_color=ui.theme.fine, marker=implot.Marker_.none))
        text = tr("{name}, up to {top}, over t") if space.numbered else tr("{name}, up to {top}")
        axis_name(ui, text.format(name=tr(chart.name), top=figure(top, ".3g")), right=True)
        implot.end_plot()


def _marks(ui: Ui, name: str, chart: Marks, space: Space) -> None:
    t = np.nan_to_num(chart.t.astype(np.float64))
    edges = np.nan_to_num(chart.edges.astype(np.float64))
    if _begin(ui, name, np.concatenate([t, edges]), 1.0, space):
        if len(edges):
            line = implot.Spec(line_color=faded(ui.theme.muted, 0.5))
            implot.plot_inf_lines("bins", edges, line)
        if len(t):
            dots = implot.Spec(line_color=ui.theme.fine, marker=implot.Marker_.circle, marker_size=0.15 * ui.em)
            implot.plot_stems("samples", t, np.full(len(t), 0.5), 0, dots)
        axis_name(ui, tr("samples and their bins, over t") if len(edges) else tr("samples, over t"), right=True)
        implot.end_plot()


def _bar_code(ui: Ui, name: str, chart: BarCode, _: Space) -> None:
    """A row of bars per name in the diverging colour map, with its scale below."""
    names = [tr(text) for text in chart.names]
    label = max(imgui.calc_text_size(text).x for text in names) + 0.5 * ui.em
    width_left = imgui.get_content_region_avail().x
    high = min(1.1 * ui.em, 8 * ui.em / len(chart.names))
    draw = imgui.get_window_draw_list()
    peak = chart.peak if np.isfinite(chart.peak) and chart.peak > 0 else 1.0
    for text, values in zip(names, chart.values, strict=True):
        at = imgui.get_cursor_screen_pos()
        if high > 0.8 * ui.em:
            draw.add_text(at, packed(ui.theme.muted), text)
        width = (width_left - label) / max(len(values), 1)
        for k, rgb in enumerate(colored(values, -peak, peak, "signed").tolist()):
            low = ImVec2(at.x + label + k * width, at.y)
            draw.add_rect_filled(low, ImVec2(low.x + max(width - 0.5, 0.5), at.y + high - 1), packed(color_of(rgb)))
        imgui.dummy(ImVec2(width_left, high))
        if imgui.is_item_hovered():
            k = int((imgui.get_mouse_pos().x - at.x - label) // max(width, 1e-6))
            if 0 <= k < len(values):
                value = figure(float(values[k]), ".4g")
                tip = tr("{name} {i} of {n}: {value}")
                imgui.set_tooltip(tip.format(name=text, i=k + 1, n=len(values), value=value))
    hint(ui, tr("−{peak} violet … {peak} orange").format(peak=figure(peak, ".3g")))


def _transfer(ui: Ui, name: str, chart: Transfer, space: Space) -> None:
    edges, cdf, u, draws = (np.nan_to_num(v.astype(np.float64)) for v in chart)
    line = imgui.get_text_line_height_with_spacing()  # the title is above it, because the curve needs the whole plot
    imgui.text_colored(ui.theme.muted, tr("levels through the inverse CDF, over t"))
    if _begin(ui, name, edges, 1.0, space._replace(high=max(space.high - line, CHART_EM[0] * ui.em))):
        some = np.linspace(0, len(u) - 1, min(len(u), 24)).astype(int)
        for k in some.tolist():  # from its level to the curve, then down to its draw
            way = implot.Spec(line_color=faded(ui.theme.coarse, 0.35))
            implot.plot_line("way", np.array([edges[0], draws[k], draws[k]]), np.array([u[k], u[k], 0.0]), way)
        implot.plot_line("cdf", edges, cdf, implot.Spec(line_color=ui.theme.fine, line_weight=0.12 * ui.em))
        implot.end_plot()


def _colors(ui: Ui, name: str, chart: Colors, _: Space) -> None:
    for text, rgb in zip(chart.names, chart.rgb, strict=True):
        swatch(ui, rgb)
        imgui.same_line(0, 0.4 * ui.em)
        imgui.text_colored(ui.theme.muted, tr(text))


def _pictures(ui: Ui, name: str, chart: Pictures, space: Space) -> None:
    line = imgui.get_text_line_height_with_spacing()
    wide = imgui.get_content_region_avail().x
    picture_stack(ui, name, chart, (wide, max(space.high - (0 if space.numbered else line), CHART_EM[0] * ui.em)))


CHARTS: dict[type[Chart], Callable[[Ui, str, Any, Space], None]] = {
    Stems: _stems, Marks: _marks, BarCode: _bar_code, Transfer: _transfer, Colors: _colors,
    Pictures: _pictures,
}  # fmt: skip
