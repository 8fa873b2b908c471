"""The plots of a ray by hand: densities to be dragged, transmittance and weights, and strips of colours and samples."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.common.language import tr
from nerf_core.probe import HandRay, HandTerms, hand_cdf

from ..model.hand_bench import BEHIND, HandBench
from ..ui.axes import axis_name, number_ticks, ticks_at
from ..ui.widgets import color_of, faded, packed, tints
from .plot_marks import be_item, pixels, row_of, ticks
from .ray_steps import wants_log

if TYPE_CHECKING:
    from ..ui.contract import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
PLOT |= implot.Flags_.no_box_select
HANDLE_EM, REACH_EM = 0.52, 0.9  # the radius of a handle, and the distance at which the mouse still hits it
END_EM = 0.4  # the same for the line at the ray's end
ROOM = 1.25  # the σ axis reaches so far above the densest sample
LEAST_TOP = 1.0  # and at least to this density
ROW_EM = 1.05  # height of a row of the strip
BESIDE_EM = 0.8  # room beside a plot: half of the label of a tick at its end
CURVE = 16  # points of the transmittance's curve in a stretch
FLOOR, CEILING = -0.07, 1.07  # of the σ axis, where 0 is no density and 1 the top: handles have room at both ends
DENSITY_SHARE = 0.6  # of the plots' height, for that of the densities


class HandPlots:
    """Draws a bench and lets the mouse drag its samples. The axes stay while the mouse is down."""

    def __init__(self) -> None:
        self._top, self._root = LEAST_TOP, False
        self._until = 1.0  # where the axis over t ends
        self._held: int | None = None  # the sample that is dragged; −1: the ray's end
        self._aside = (0.0, 0.0)  # from the mouse to its handle, in pixels

    def fit(self, ray: HandRay) -> None:
        """Choose the axes for a new ray. The σ axis is one of roots where a linear one would flatten most samples."""
        self._root = wants_log(ray.sigma)
        self._top = max(ROOM * float(ray.sigma.max(initial=0.0)), LEAST_TOP)
        self._until = ray.far + BEHIND * (ray.far - ray.near)

    def draw(self, ui: Ui, bench: HandBench, rows: tuple[tuple[str, np.ndarray], ...], size: ImVec2) -> None:
        """Draw everything into `size`, and do to the bench what the mouse does.

        Args:
            ui: where to draw.
            bench: the samples.
            rows: names and distances of samples to show as ticks. With any, the CDF of the weights is drawn too.
            size: of all plots together, in pixels.
        """
        self._regrow(bench.ray)
        pad = 0.25 * ui.em
        implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
        implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(BESIDE_EM * ui.em, pad))
        implot.push_style_var(implot.StyleVar_.label_padding, ImVec2(pad, pad))
        imgui.push_style_var(imgui.StyleVar_.item_spacing, ImVec2(0, 0.1 * ui.em))
        strip = (2 + len(rows)) * ROW_EM * ui.em + 2 * pad
        axis = imgui.get_text_line_height() + pad
        height = max(size.y - strip - axis - 0.2 * ui.em, 6 * ui.em)
        if implot.begin_aligned_plots("hand"):
            self._densities(ui, bench, ImVec2(size.x, DENSITY_SHARE * height + axis))
            terms = bench.terms  # after the mouse has changed the samples
            self._weights(ui, bench, terms, bool(rows), ImVec2(size.x, (1 - DENSITY_SHARE) * height))
            self._strip(ui, bench, terms, rows, ImVec2(size.x, strip))
            implot.end_aligned_plots()
        imgui.pop_style_var()
        implot.pop_style_var(3)

    def _regrow(self, ray: HandRay) -> None:
        """Let the axes follow what was changed, but not under the mouse."""
        if imgui.is_mouse_down(imgui.MouseButton_.left):
            return
        self._held = None
        if float(ray.sigma.max(initial=0.0)) > 0.98 * self._top:
            self._top = ROOM * float(ray.sigma.max())
        length = ray.far - ray.near
        if not ray.far + 0.02 * length < self._until < ray.far + 0.5 * length:
            self._until = ray.far + BEHIND * length

    def _place(self, sigma: np.ndarray) -> np.ndarray:
        """The height of densities on the axis, from 0 to 1."""
        share = np.maximum(sigma, 0.0) / self._top
        return np.sqrt(share) if self._root else share

    def _sigma(self, height: float) -> float:
        """The density at a height: the inverse of `_place`."""
        height = float(np.clip(height, 0.0, 1.0))
        return self._top * (height**2 if self._root else height)

    def _share_t(self, ray: HandRay, flags: implot.AxisFlags_) -> None:
        implot.setup_axis(X1, None, flags | implot.AxisFlags_.lock | implot.AxisFlags_.no_highlight)
        margin = 0.02 * (self._until - ray.near)
        implot.setup_axis_limits(X1, ray.near - margin, self._until, implot.Cond_.always)
        number_ticks(X1, ray.near - margin, self._until)

    # ---- densities --------------------------------------------------------------------------------------------------

    def _densities(self, ui: Ui, bench: HandBench, size: ImVec2) -> None:
        if not implot.begin_plot("##densities", size, PLOT):
            return
        ray = bench.ray
        self._share_t(ray, implot.AxisFlags_.none)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock | implot.AxisFlags_.no_highlight)
        implot.setup_axis_limits(Y1, FLOOR, CEILING, implot.Cond_.always)
        marks = _round_marks(self._top)
        ticks_at(Y1, self._place(np.array(marks)).tolist(), marks)
        implot.setup_finish()
        axis_name(ui, tr("σ (1/unit), roots") if self._root else tr("σ (1/unit)"))
        _end_line(ui, ray, "far")
        self._mouse(ui, bench)
        ray = bench.ray
        x, y = pixels(ray.edges), self._heights(ray.sigma)
        floor, top = (implot.plot_to_pixels(0.0, height).y for height in (0.0, 1.0))
        draw, theme = implot.get_plot_draw_list(), ui.theme
        implot.push_plot_clip_rect()
        fills = tints(ray.rgb, np.where(np.arange(len(ray.t)) == bench.chosen, 0.75, 0.45))
        for i, fill in enumerate(fills):
            chosen, left = i == bench.chosen, ImVec2(float(x[i]), float(y[i]))
            corner = ImVec2(float(x[i + 1]), floor)
            draw.add_rect_filled(left, corner, fill)
            line = packed(theme.density if chosen else faded(theme.density, 0.6))
            draw.add_line(left, ImVec2(corner.x, left.y), line, 0.12 * ui.em)
            draw.add_line(left, ImVec2(left.x, floor), line, 0.08 * ui.em)
        implot.pop_plot_clip_rect()
        at, extent = implot.get_plot_pos(), implot.get_plot_size()
        implot.push_plot_clip_rect(HANDLE_EM * ui.em)  # a handle may stand out of the plot
        for i in [*(k for k in range(len(ray.t)) if k != bench.chosen), bench.chosen][: len(ray.t)]:
            self._handle(ui, i, ray.rgb[i], ImVec2(float(x[i]), float(y[i])), i == bench.chosen)
        implot.pop_plot_clip_rect()
        be_item(at.x, top, at.x + extent.x, floor)
        ui.mark("hand.densities")
        end = float(pixels(np.array([ray.far]))[0])
        be_item(end - 2, at.y, end + 2, at.y + extent.y)
        ui.mark("hand.far")
        implot.end_plot()

    def _heights(self, sigma: np.ndarray) -> np.ndarray:
        """The screen y in pixels (N,) of densities in the current plot. Those above the axis lie on its upper end."""
        floor, top = (implot.plot_to_pixels(0.0, height).y for height in (0.0, 1.0))
        return floor + np.clip(self._place(sigma), 0, 1) * (top - floor)

    def _handle(self, ui: Ui, i: int, rgb: np.ndarray, at: ImVec2, chosen: bool) -> None:
        draw, r, text = implot.get_plot_draw_list(), HANDLE_EM * ui.em, str(i + 1)
        draw.add_circle_filled(at, r, packed(color_of(rgb)))
        ring = ui.theme.text if chosen else faded(ui.theme.text, 0.55)
        draw.add_circle(at, r, packed(ring), thickness=(0.14 if chosen else 0.07) * ui.em)
        bright = float(np.clip(rgb, 0, 1) @ [0.299, 0.587, 0.114]) > 0.5
        small = 0.75 * ui.em
        extent = imgui.calc_text_size(text)
        corner = ImVec2(at.x - 0.375 * extent.x, at.y - 0.375 * extent.y)
        draw.add_text(
            imgui.get_font(), small, corner, packed(ImVec4(0, 0, 0, 1) if bright else ImVec4(1, 1, 1, 1)), text
        )
        be_item(at.x - r, at.y - r, at.x + r, at.y + r)
        ui.mark(f"hand.sample {i + 1}")

    def _mouse(self, ui: Ui, bench: HandBench) -> None:
        """Choose, drag and add samples."""
        ray, mouse = bench.ray, imgui.get_mouse_pos()
        hovered = implot.is_plot_hovered()
        under = self._under(ui, bench, mouse) if hovered and self._held is None else self._held
        if under is not None:
            ends = under < 0
            imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew if ends else imgui.MouseCursor_.hand)
        if hovered and imgui.is_mouse_double_clicked(imgui.MouseButton_.left) and not self._on_handle(ui, ray, mouse):
            place = implot.get_plot_mouse_pos()
            bench.add(place.x, self._sigma(place.y))
            self._held, self._aside = (bench.chosen, (0.0, 0.0)) if bench.ray is not ray else (None, (0.0, 0.0))
        elif hovered and imgui.is_mouse_clicked(imgui.MouseButton_.left) and under is not None:
            self._held = under
            grip = pixels(ray.edges)[under], (0.0 if under < 0 else self._heights(ray.sigma)[under])
            self._aside = float(grip[0]) - mouse.x, float(grip[1]) - mouse.y
            if under >= 0:
                bench.choose(under)
        elif self._held is not None and imgui.is_mouse_dragging(imgui.MouseButton_.left):
            place = implot.pixels_to_plot(mouse.x + self._aside[0], mouse.y + self._aside[1])
            if self._held < 0:
                bench.stretch(min(place.x, self._until - 0.01 * (self._until - ray.near)), "end")
            else:
                bench.move(self._held, place.x, self._sigma(place.y), "drag")
                self._held = bench.chosen

    def _on_handle(self, ui: Ui, ray: HandRay, mouse: ImVec2) -> int | None:
        if not len(ray.t):
            return None
        apart = np.hypot(pixels(ray.t) - mouse.x, self._heights(ray.sigma) - mouse.y)
        nearest = int(np.argmin(apart))
        return nearest if apart[nearest] < REACH_EM * ui.em else None

    def _under(self, ui: Ui, bench: HandBench, mouse: ImVec2) -> int | None:
        """The sample under the mouse, by its handle or its bar; −1 for the ray's end."""
        ray = bench.ray
        handle = self._on_handle(ui, ray, mouse)
        if handle is not None:
            return handle
        edges = pixels(ray.edges)
        if abs(float(edges[-1]) - mouse.x) < END_EM * ui.em:
            return -1
        stretch = int(np.searchsorted(edges, mouse.x, side="right")) - 1
        if 0 <= stretch < len(ray.t) and mouse.y > self._heights(ray.sigma)[stretch]:
            return stretch
        return None

    # ---- transmittance, opacity, weights ----------------------------------------------------------------------------

    def _weights(self, ui: Ui, bench: HandBench, terms: HandTerms, cdf: bool, size: ImVec2) -> None:
        if not implot.begin_plot("##weights", size, PLOT):
            return
        ray, theme = bench.ray, ui.theme
        self._share_t(ray, implot.AxisFlags_.no_tick_labels)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock | implot.AxisFlags_.no_highlight)
        implot.setup_axis_limits(Y1, 0, 1.08, implot.Cond_.always)
        ticks_at(Y1, (0.0, 0.5, 1.0))
        edges = np.concatenate([[ray.near], ray.edges])
        bars = implot.Spec(
            fill_color=faded(theme.fine, 0.5), line_color=theme.fine, flags=implot.StairsFlags_.shaded
        )  # fmt: skip
        implot.plot_stairs("w", edges, np.concatenate([[0.0], terms.weights, [0.0]]), bars)
        thin = implot.Spec(line_color=faded(theme.alpha, 0.9), line_weight=0.08 * ui.em)
        implot.plot_stairs("alpha", edges, np.concatenate([[0.0], terms.alpha, [0.0]]), thin)
        t, light = _light(ray, terms)
        line = implot.Spec(line_color=theme.transmittance, line_weight=0.13 * ui.em)
        implot.plot_line("T", np.append(t, self._until), np.append(light, light[-1]), line)
        names = [("T", theme.transmittance), ("α", theme.alpha), ("w", theme.fine)]
        if cdf and len(ray.t):
            way = implot.Spec(line_color=faded(theme.text, 0.8), line_weight=0.09 * ui.em)
            implot.plot_line("cdf", ray.edges, hand_cdf(ray), way)
            names.append((tr("CDF of w"), theme.text))
        _end_line(ui, ray, "")
        _legend(ui, names)
        implot.end_plot()
        ui.mark("hand.weights")

    # ---- strips -----------------------------------------------------------------------------------------------------

    def _strip(
        self, ui: Ui, bench: HandBench, terms: HandTerms, rows: tuple[tuple[str, np.ndarray], ...], size: ImVec2
    ) -> None:
        """The colours of the samples, their running sum, the pixel behind the ray's end, and other samples as ticks."""
        if not implot.begin_plot("##strip", size, PLOT):
            return
        ray = bench.ray
        bounds = (ROW_EM * np.arange(3 + len(rows))).tolist()
        self._share_t(ray, implot.AxisFlags_.no_decorations)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock | implot.AxisFlags_.invert | implot.AxisFlags_.no_grid_lines)
        implot.setup_axis_limits(Y1, 0, bounds[-1], implot.Cond_.always)
        places = [(low + high) / 2 for low, high in pairwise(bounds)]
        names = [tr("colour"), tr("sum"), *(name for name, _ in rows)]
        implot.setup_axis_ticks(Y1, places, names)
        implot.setup_finish()
        x = [*pixels(ray.edges).tolist(), implot.get_plot_pos().x + implot.get_plot_size().x]
        draw, gap = implot.get_plot_draw_list(), 0.3 * ui.em
        implot.push_plot_clip_rect()
        for row, colors in enumerate(([*ray.rgb, ray.background], [*terms.sums, terms.pixel])):
            top, bottom = row_of(bounds, row)
            for i, color in enumerate(tints(np.array(colors))):
                last = i == len(ray.t)
                left = ImVec2(x[i] + (gap if last else 0.0), top)
                draw.add_rect_filled(left, ImVec2(x[i + 1], bottom), color)
        for row, (_, t) in enumerate(rows):
            ticks(ui, t, row_of(bounds, 2 + row), ui.theme.fine if row else ui.theme.muted)
        implot.pop_plot_clip_rect()
        self._strip_tip(ray, terms, bounds)
        implot.end_plot()
        ui.mark("hand.strip")

    def _strip_tip(self, ray: HandRay, terms: HandTerms, bounds: list[float]) -> None:
        if not implot.is_plot_hovered():
            return
        mouse = implot.get_plot_mouse_pos()
        row = int(np.searchsorted(bounds, mouse.y, side="right")) - 1
        i = int(np.searchsorted(ray.edges, mouse.x, side="right")) - 1
        if row not in (0, 1) or i < 0:
            return
        behind = i == len(ray.t)
        if row == 0:
            text = tr("the background") if behind else tr("the colour of sample {i}").format(i=i + 1)
        else:
            text = tr("the pixel") if behind else tr("the sum up to sample {i}").format(i=i + 1)
        imgui.set_tooltip(text)


def _light(ray: HandRay, terms: HandTerms) -> tuple[np.ndarray, np.ndarray]:
    """The transmittance at many distances: exp(−∫ σ dt), which falls within every stretch."""
    if not len(ray.t):
        return np.array([ray.near, ray.far]), np.ones(2)
    share = np.linspace(0, 1, CURVE)
    t = ray.t[:, None] + terms.delta[:, None] * share
    light = terms.transmittance[:, None] * np.exp(-(ray.sigma * terms.delta)[:, None] * share)
    return np.append(ray.near, t.ravel()), np.append(1.0, light.ravel())


def _end_line(ui: Ui, ray: HandRay, name: str) -> None:
    """The line at the ray's end, with a grip where it has a name."""
    x = float(pixels(np.array([ray.far]))[0])
    at, size = implot.get_plot_pos(), implot.get_plot_size()
    draw, color = implot.get_plot_draw_list(), packed(faded(ui.theme.text, 0.6))
    implot.push_plot_clip_rect()
    draw.add_line(ImVec2(x, at.y), ImVec2(x, at.y + size.y), color, max(1.0, 0.08 * ui.em))
    if name:
        draw.add_text(ImVec2(x + 0.25 * ui.em, at.y + 0.1 * ui.em), packed(ui.theme.muted), name)
        foot, r = at.y + size.y, 0.35 * ui.em
        draw.add_triangle_filled(ImVec2(x - r, foot), ImVec2(x + r, foot), ImVec2(x, foot - 1.4 * r), color)
    implot.pop_plot_clip_rect()


def _legend(ui: Ui, names: list[tuple[str, ImVec4]]) -> None:
    """The names of the curves in their colours, at the right and half way up: T and the CDF are near 0 or 1 there."""
    gap = 0.6 * ui.em
    wide = sum(imgui.calc_text_size(name).x + gap for name, _ in names)
    at, size = implot.get_plot_pos(), implot.get_plot_size()
    x, draw = at.x + size.x - wide, implot.get_plot_draw_list()
    y = at.y + 0.5 * (size.y - imgui.get_text_line_height())
    plate = faded(implot.get_style().color_(implot.Col_.plot_bg), 0.85)
    implot.push_plot_clip_rect()
    corner = ImVec2(at.x + size.x, y + imgui.get_text_line_height())
    draw.add_rect_filled(ImVec2(x - 0.3 * ui.em, y), corner, packed(plate))
    for name, color in names:
        draw.add_text(ImVec2(x, y), packed(color), name)
        x += imgui.calc_text_size(name).x + gap
    implot.pop_plot_clip_rect()


def _round_marks(top: float) -> list[float]:
    """Two to five round numbers from 0 to under `top`."""
    step = 10.0 ** np.floor(np.log10(top))
    step = next(s for s in (2 * step, step, step / 2, step / 5) if top / s >= 2)
    return (step * np.arange(int(0.98 * top / step) + 1)).tolist()
