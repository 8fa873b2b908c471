"""Plots of Flatland: the chosen ray's w, T and σ over t, and the PSNR over steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import tr
from nerf_core.lab.flatland.view import FlatRay
from nerf_core.lab.records import Curve

from ..ui.axes import axis_name, fitted_axes, ticks_at
from ..ui.widgets import faded, packed, tints

if TYPE_CHECKING:
    from ..ui.contract import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
LEAST_SIGMA = 10.0  # the density's axis shows at least so much, so that fog looks like fog
WIDE_EM = 20.0  # width of a plot from which its axis has its whole name
LOW_EM = 6.0  # height of the curve's plot under which its axis has fewer numbers
STRIP_EM = 0.7  # height of the strip of colours


def ray_plots(ui: Ui, ray: FlatRay, size: ImVec2) -> None:
    """Draw w and T over t, then σ with the world's, and what each sample paints. w is a share of its pass's largest."""
    gap = imgui.get_style().item_spacing.y
    high = (size.y - STRIP_EM * ui.em - 2 * gap) / 2
    axis = imgui.get_text_line_height()
    implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
    implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(0.4 * ui.em, 0.25 * ui.em))
    implot.push_style_var(implot.StyleVar_.label_padding, ImVec2(0.25 * ui.em, 0.2 * ui.em))
    if implot.begin_aligned_plots("flat ray"):
        _weights(ui, ray, ImVec2(size.x, high - axis / 2))
        left, right = _density(ui, ray, ImVec2(size.x, high + axis / 2))
        implot.end_aligned_plots()
        _colors(ui, ray, left, right)
    implot.pop_style_var(3)


def _edges(ray: FlatRay, t: np.ndarray) -> np.ndarray:
    """Return the bounds of samples' intervals: each reaches to the next, the last to the ray's end."""
    return np.append(t, ray.far).astype(np.float64)


def _stairs(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[-1]).astype(np.float64)


def _weights(ui: Ui, ray: FlatRay, size: ImVec2) -> None:
    if not implot.begin_plot("##flat weights", size, PLOT):
        return
    _share_t(ray, implot.AxisFlags_.no_tick_labels)
    implot.setup_axis(Y1, None, implot.AxisFlags_.lock)
    implot.setup_axis_limits(Y1, 0, 1.05, implot.Cond_.always)
    ticks_at(Y1, (0.5, 1.0))
    for one in ray.passes:
        last = one is ray.passes[-1]
        color = ui.theme.coarse if one.name == "coarse" else ui.theme.fine
        spec = implot.Spec(line_color=color, line_weight=0.1 * ui.em)
        if last:
            spec.fill_color, spec.flags = faded(color, 0.5), implot.StairsFlags_.shaded
        implot.plot_stairs(
            f"{one.name} w", _edges(ray, one.t), _stairs(one.weights / max(float(one.weights.max()), 1e-9)), spec
        )
        if last:
            line = implot.Spec(line_color=ui.theme.transmittance, line_weight=0.12 * ui.em)
            behind = one.transmittance[-1:] * (1 - one.alpha[-1:])
            seen = np.concatenate([one.transmittance, behind]).astype(np.float64)
            implot.plot_line("T", _edges(ray, one.t), seen, line)
    axis_name(
        ui, tr("w / largest w, T") if size.x > WIDE_EM * ui.em else "w, T", right=True, height=0.5
    )  # T is 1 or 0 there
    implot.end_plot()
    ui.mark("flatland.weights")


def _density(ui: Ui, ray: FlatRay, size: ImVec2) -> tuple[float, float]:
    """Draw σ. Returns the ends of the t axis on the screen."""
    if not implot.begin_plot("##flat density", size, PLOT):
        return 0.0, 0.0
    _share_t(ray, implot.AxisFlags_.none)
    top = max(LEAST_SIGMA, float(ray.true_sigma.max()), *(float(one.sigma.max()) for one in ray.passes))
    implot.setup_axis(Y1, None)
    implot.setup_axis_limits(Y1, 0, 1.25 * top, implot.Cond_.always)
    half = 10 ** np.floor(np.log10(top))
    ticks = [half * k for k in range(int(1.25 * top / half) + 1)]
    ticks = ticks[:: -(-len(ticks) // 4)]
    ticks_at(Y1, ticks)
    truth = implot.Spec(line_color=faded(ui.theme.text, 0.45), line_weight=0.1 * ui.em)
    truth.fill_color, truth.flags = faded(ui.theme.text, 0.12), implot.LineFlags_.shaded
    implot.plot_line("world", ray.true_t.astype(np.float64), ray.true_sigma.astype(np.float64), truth)
    for one in ray.passes[-1:]:
        line = implot.Spec(line_color=ui.theme.density, line_weight=0.12 * ui.em)
        implot.plot_stairs("sigma", _edges(ray, one.t), _stairs(one.sigma), line)
    axis_name(ui, tr("σ over t; grey: world"), right=True)
    left, right = implot.get_plot_pos().x, implot.get_plot_pos().x + implot.get_plot_size().x
    implot.end_plot()
    ui.mark("flatland.density")
    return left, right


def _share_t(ray: FlatRay, flags: implot.AxisFlags_) -> None:
    implot.setup_axis(X1, None, flags)
    implot.setup_axis_limits(X1, ray.near, ray.far, implot.Cond_.always)
    ticks = np.arange(np.ceil(2 * ray.near), 2 * ray.far) / 2
    ticks_at(X1, ticks.tolist())


def _colors(ui: Ui, ray: FlatRay, left: float, right: float) -> None:
    """Draw, under the t axis, the colour of each sample, as strong as its weight."""
    at, high = imgui.get_cursor_screen_pos(), STRIP_EM * ui.em
    draw, one = imgui.get_window_draw_list(), ray.passes[-1]
    scale = (right - left) / max(ray.far - ray.near, 1e-9)
    x = (left + (_edges(ray, one.t) - ray.near) * scale).tolist()
    colors = tints(one.rgb, np.clip(one.weights / max(float(one.weights.max()), 1e-9), 0, 1))
    draw.add_rect_filled(ImVec2(left, at.y), ImVec2(right, at.y + high), packed(ui.theme.hairline))
    for begin, end, color in zip(x[:-1], x[1:], colors, strict=True):
        draw.add_rect_filled(ImVec2(begin, at.y), ImVec2(end, at.y + high), color)
    imgui.dummy(ImVec2(max(right - at.x, 1.0), high))
    ui.mark("flatland.colors")
    imgui.set_item_tooltip(tr("the samples' colours, as strong as their weights"))


def psnr_plot(ui: Ui, curves: Sequence[Curve], size: ImVec2) -> None:
    """Draw the PSNR of held-out photos over steps; behind it, fainter, that before the last knob was turned."""
    implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
    implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(ui.em, 0.25 * ui.em))
    if implot.begin_plot("##flat psnr", size, PLOT):
        between = 5 if size.y > LOW_EM * ui.em else 10
        fitted_axes([(curve.x, curve.y) for curve in curves], range(0, 61, between))
        for k, curve in reversed(list(enumerate(curves))):
            color = faded(ui.theme.muted, 0.7) if k else ui.theme.accent
            line = implot.Spec(line_color=color, line_weight=(0.08 if k else 0.14) * ui.em)
            implot.plot_line(f"##{k}", curve.x.astype(np.float64), curve.y.astype(np.float64), line)
        axis_name(ui, tr("PSNR held out (dB)") if size.y > LOW_EM * ui.em else tr("dB"), right=True, height=1.0)
        implot.end_plot()
        ui.mark("flatland.psnr")
    implot.pop_style_var(2)
