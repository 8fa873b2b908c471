"""Plots of one ray over t: weights and transmittance, density, sample positions and colours, on one shared axis."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import tr
from nerf_core.probe import RayProbe
from nerf_core.probe.axis import Axis

from ..ui.axes import Limits, axis_name, number_ticks, ticks_at
from ..ui.widgets import faded, packed
from .plot_marks import be_item, color_strip, depth_marks, row_of, ticks, x_of
from .ray_steps import Steps, sample_at, wants_log

if TYPE_CHECKING:
    from ..ui.contract import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
LOG_DECADES = 4  # decades below the peak density that a log axis shows
DRAG_ID = 0
REACH_EM = 0.3  # the mouse still hits a sample at this distance from its interval
BESIDE_EM = 1.0  # room beside a plot: half of the label of a tick at its end
ROW_EM = 1.0  # height of a row of the strip; the ticks of all passes share one row, so that names do not overlap

LogChoice = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class Opened:
    """The content of the plots.

    passes: those of `steps_of`, at the places of `axis`.
    axis: where distances lie on the axis.
    units: the unit of length in density's 1/length.
    point_t: the distance of the radiance point.
    marked: a sample that the user points at in some panel.
    """

    ray: RayProbe
    passes: tuple[Steps, ...]
    axis: Axis
    units: Literal["unit", "NDC unit"]
    point_t: float
    marked: tuple[Steps, int] | None = None


class RayPlots:
    """Three plots with one axis over t, and a strip of the whole ray. The axis is set when another ray is opened.

    It then shows the part of the ray that has weight, until the user moves it.
    """

    def __init__(self) -> None:
        self.log_choice: LogChoice = "auto"
        self.log_density = False
        self.hovered: tuple[Steps, int] | None = None
        self._t, self._sigma = Limits(), Limits()
        self._sigma_fits = (0.0, 1.0)  # the limits that fit the densities
        self._dragged: float | None = None

    def open(self, passes: tuple[Steps, ...], low: float, high: float) -> None:
        """Choose limits and scale for a newly opened ray. low, high: places on the axis between which it has weight."""
        self.show(low, high)
        self._dragged = None
        self.choose_log(self.log_choice, passes)

    def show(self, low: float, high: float) -> None:
        """Show the part of the axis between two places."""
        air = 0.01 * max(high - low, 1e-6)  # a ray without length still needs an axis
        self._t.set(low - air, high + air)

    def shows(self, low: float, high: float) -> bool:
        """Return whether all between two places is shown."""
        return self._t.low.value <= low and self._t.high.value >= high

    def shown(self) -> tuple[float, float]:
        """Return the places between which the axis runs."""
        return self._t.shown()

    def choose_log(self, choice: LogChoice, passes: tuple[Steps, ...]) -> None:
        """Choose the density's axis. "auto" chooses for this ray, and again for each one opened later."""
        self.log_choice = choice
        self.log_density = bool(passes) and wants_log(passes[-1].sigma) if choice == "auto" else choice == "on"
        self._scale_density(passes)

    def _scale_density(self, passes: tuple[Steps, ...]) -> None:
        top = max([float(p.sigma.max()) for p in passes], default=0.0) or 1.0
        self._sigma_fits = (top * 10.0**-LOG_DECADES, 3 * top) if self.log_density else (0.0, 1.2 * top)
        self._sigma.set(*self._sigma_fits)

    def draw(self, ui: Ui, opened: Opened, size: ImVec2) -> float | None:
        """Draw everything into `size`. Returns the t to which the user drags the radiance point, else None."""
        ray, passes = opened.ray, opened.passes
        if max((float(p.sigma.max()) for p in passes), default=0.0) > self._sigma_fits[1]:
            self._scale_density(passes)  # training has raised it beyond the axis
        pad = 0.25 * ui.em
        implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
        implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(BESIDE_EM * ui.em, pad))
        implot.push_style_var(implot.StyleVar_.label_padding, ImVec2(pad, pad))
        reading, dragged = None, None
        strip = (3 if passes else 2) * ROW_EM * ui.em + 2 * pad
        gap = ImVec2(0, 0.1 * ui.em)
        imgui.push_style_var(imgui.StyleVar_.item_spacing, gap)
        axis = imgui.get_text_line_height() + pad  # the density plot also carries the t axis
        height = max((size.y - strip - axis - 2 * gap.y) / 2, 3 * ui.em)
        if implot.begin_aligned_plots("ray"):
            if self._dragged is not None:  # the line stays at the mouse until the worker has followed
                opened = replace(opened, point_t=self._dragged)
            for plot, plot_height in ((self._weights, height), (self._density, height + axis)):
                moved, read = plot(ui, opened, ImVec2(size.x, plot_height))
                dragged, reading = moved if moved is not None else dragged, read or reading
            reading = self._strip(ui, passes, ImVec2(size.x, strip)) or reading
            implot.end_aligned_plots()
        implot.pop_style_var(3)
        imgui.pop_style_var()
        self.hovered = reading
        if dragged is None:
            if not imgui.is_mouse_down(imgui.MouseButton_.left):
                self._dragged = None
            return None
        self._dragged = float(np.clip(opened.axis.distance(np.array(dragged)), ray.near, ray.far))
        return self._dragged

    def _weights(self, ui: Ui, opened: Opened, size: ImVec2) -> tuple[float | None, tuple[Steps, int] | None]:
        if not implot.begin_plot("##weights", size, PLOT):
            return None, None
        passes = opened.passes
        self._share_t(implot.AxisFlags_.no_tick_labels)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock)
        implot.setup_axis_limits(Y1, 0, 1.05, implot.Cond_.always)
        ticks_at(Y1, (0.5, 1.0))  # a label 0 would touch the topmost label of the next plot
        for steps in passes[-1:]:
            filled = implot.Spec(fill_color=faded(ui.theme.fine, 0.55), flags=implot.StairsFlags_.shaded)
            filled.line_color = ui.theme.fine
            implot.plot_stairs("fine weight", steps.edges, _of_largest(steps), filled)
        for steps in passes[:-1]:
            outline = implot.Spec(line_color=ui.theme.coarse, line_weight=0.1 * ui.em)
            implot.plot_stairs(f"{steps.probe.name} weight", steps.edges, _of_largest(steps), outline)
        thin = implot.Spec(line_color=faded(ui.theme.alpha, 0.8), line_weight=0.07 * ui.em)
        for steps in passes[-1:]:
            implot.plot_stairs("alpha", steps.edges, steps.alpha, thin)
        line = implot.Spec(line_color=ui.theme.transmittance, line_weight=0.12 * ui.em)
        for steps in passes[-1:]:
            implot.plot_line("transmittance", steps.edges, steps.transmittance, line)
        if not passes:  # there are no samples
            ends = opened.axis.place(np.array([opened.ray.near, opened.ray.far]))
            implot.plot_line("transmittance", ends, np.ones(2), line)
        axis_name(ui, tr("w / largest w, T, α"), right=True, height=0.5)  # T is 1 or 0 there
        depth_marks(ui, opened.ray, opened.axis, glyphs=True)
        result = self._drag_point(ui, opened), self._read(ui, passes, opened.marked)
        implot.end_plot()
        ui.mark("ray.weights")
        return result

    def _density(self, ui: Ui, opened: Opened, size: ImVec2) -> tuple[float | None, tuple[Steps, int] | None]:
        if not implot.begin_plot("##density", size, PLOT):
            return None, None
        passes = opened.passes
        self._share_t(implot.AxisFlags_.none)
        if opened.axis.turn is not None:
            places, labels = opened.axis.ticks(*self.shown())
            implot.setup_axis_ticks(X1, places.tolist(), [tr(label) for label in labels])
        else:
            number_ticks(X1, *self.shown())
        implot.setup_axis(Y1, None)
        low, high = self._sigma_fits
        implot.setup_axis_scale(Y1, implot.Scale_.log10 if self.log_density else implot.Scale_.linear)
        self._sigma.link(Y1, None if self.log_density else 2)
        if self.log_density:
            decades = [10.0**k for k in range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)][::-2]
            ticks_at(Y1, decades)
        for steps in passes:
            last = steps is passes[-1]
            # a log axis cannot show 0: empty space lies on its lower limit
            sigma = np.maximum(steps.sigma, low) if self.log_density else steps.sigma
            color = ui.theme.density if last else ui.theme.coarse
            line = implot.Spec(line_color=color, line_weight=(0.12 if last else 0.08) * ui.em)
            implot.plot_stairs(f"{steps.probe.name} density", steps.edges, sigma, line)
        axis_name(ui, tr("σ (1/unit)") if opened.units == "unit" else tr("σ (1/NDC unit)"), right=True)
        depth_marks(ui, opened.ray, opened.axis, glyphs=False)
        result = self._drag_point(ui, opened), self._read(ui, passes, opened.marked)
        implot.end_plot()
        ui.mark("ray.density")
        return result

    def _strip(self, ui: Ui, passes: tuple[Steps, ...], size: ImVec2) -> tuple[Steps, int] | None:
        """The positions of each pass's samples, the colours of the last pass, and their contributions to the pixel."""
        if not implot.begin_plot("##strip", size, PLOT):
            return None
        bounds = np.cumsum([0.0, *(ROW_EM / len(passes) for _ in passes), ROW_EM, ROW_EM]).tolist()
        self._share_t(implot.AxisFlags_.no_decorations)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock | implot.AxisFlags_.invert | implot.AxisFlags_.no_grid_lines)
        implot.setup_axis_limits(Y1, 0, bounds[-1], implot.Cond_.always)
        named = [0.0, *bounds[len(passes) :]] if passes else bounds  # the ticks of all passes have one name
        places = [(low + high) / 2 for low, high in pairwise(named)]
        implot.setup_axis_ticks(Y1, places, [tr("samples"), tr("colour"), tr("× weight")][-len(places) :])
        implot.setup_finish()
        implot.push_plot_clip_rect()
        for row, steps in enumerate(passes):
            last = steps is passes[-1]
            ticks(ui, steps.t, row_of(bounds, row), ui.theme.fine if last else ui.theme.coarse)
        for steps in passes[-1:]:
            color_strip(steps, row_of(bounds, len(passes)), np.ones(len(steps.probe.t)))
            peak = max(float(steps.weights.max()), 1e-12)  # 1e-12: if all are zero nothing is painted
            color_strip(steps, row_of(bounds, len(passes) + 1), np.nan_to_num(steps.probe.weights) / peak)
        implot.pop_plot_clip_rect()
        reading = None
        if implot.is_plot_hovered():
            row = int(np.searchsorted(bounds, implot.get_plot_mouse_pos().y, side="right")) - 1
            reading = self._read(ui, passes[max(row, 0) : row + 1] or passes[-1:], None)
        implot.end_plot()
        ui.mark("ray.strip")
        return reading

    def _share_t(self, flags: implot.AxisFlags_) -> None:
        implot.setup_axis(X1, None, flags)
        self._t.link(X1, None)

    def _drag_point(self, ui: Ui, opened: Opened) -> float | None:
        """Draw the point's line. Returns the place to which the user drags it, else None."""
        point = float(opened.axis.place(np.array(opened.point_t)))
        unseen = faded(ui.theme.point, 0.0)  # implot's own caps would hide the peak on which the point usually is
        changed, t, *_ = implot.drag_line_x(DRAG_ID, point, unseen, 0.15 * ui.em, implot.DragToolFlags_.no_fit)
        x, top, r = x_of(point), implot.get_plot_pos().y, 0.4 * ui.em
        draw, color, foot = implot.get_plot_draw_list(), packed(ui.theme.point), top + implot.get_plot_size().y
        implot.push_plot_clip_rect()
        draw.add_line(ImVec2(x, top), ImVec2(x, foot), color, max(1.0, 0.08 * ui.em))
        draw.add_triangle_filled(ImVec2(x - r, foot), ImVec2(x + r, foot), ImVec2(x, foot - 1.4 * r), color)  # its grip
        implot.pop_plot_clip_rect()
        be_item(x - 0.3 * ui.em, top, x + 0.3 * ui.em, top + implot.get_plot_size().y)
        ui.mark("ray.point")
        return max(t, 0.0) if changed else None  # a ray does not reach behind its camera

    def _read(self, ui: Ui, passes: tuple[Steps, ...], marked: tuple[Steps, int] | None) -> tuple[Steps, int] | None:
        """Return the sample under the mouse, of any pass. The marked sample is highlighted in this plot."""
        if marked is not None:
            steps, index = marked
            x = x_of(float(steps.t[index]))
            top, height = implot.get_plot_pos().y, implot.get_plot_size().y
            implot.get_plot_draw_list().add_line(ImVec2(x, top), ImVec2(x, top + height), packed(ui.theme.text))
        if not implot.is_plot_hovered() or not passes:
            return None
        reach = REACH_EM * ui.em * implot.get_plot_limits().x.size() / max(implot.get_plot_size().x, 1.0)
        return sample_at(passes, implot.get_plot_mouse_pos().x, reach)


def _of_largest(steps: Steps) -> np.ndarray:
    """Weights (E,) divided by the largest of their pass, because many narrow samples have smaller weights than few."""
    return steps.weights / max(float(steps.weights.max()), 1e-12)  # 1e-12: if all are zero they stay zero
