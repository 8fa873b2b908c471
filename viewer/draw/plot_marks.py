"""Marks for plots over t: the ray's depths, and the samples' positions and colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.common.language import marked
from nerf_core.probe import RayProbe
from nerf_core.probe.axis import Axis

from ..ui.widgets import faded, packed, tints
from .ray_steps import Steps

if TYPE_CHECKING:
    from ..ui.contract import Ui

Glyph = Callable[[imgui.ImDrawList, ImVec2, float, int], None]


def triangle(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_triangle_filled(ImVec2(at.x - r, at.y - r), ImVec2(at.x + r, at.y - r), ImVec2(at.x, at.y + r), color)


def arrow(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_triangle_filled(ImVec2(at.x - r, at.y - r), ImVec2(at.x + r, at.y), ImVec2(at.x - r, at.y + r), color)


def diamond(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_ngon_filled(at, 1.2 * r, color, 4)


def circle(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_circle(at, r, color, thickness=0.4 * r)


DEPTHS: tuple[tuple[str, str, Glyph], ...] = (
    (marked("expected"), "depth_expected", triangle),
    (marked("median"), "depth_median", diamond),
    (marked("strongest"), "depth_strongest", circle),
)


def depth_marks(ui: Ui, ray: RayProbe, axis: Axis, *, glyphs: bool) -> None:
    """Draw lines at the ray's depths. glyphs: also draw their signs; of a depth behind the end, an arrow at the end."""
    draw, top = implot.get_plot_draw_list(), implot.get_plot_pos().y
    end = implot.get_plot_pos().x + implot.get_plot_size().x
    implot.push_plot_clip_rect()
    for row, (_, name, glyph) in enumerate(DEPTHS):
        t = getattr(ray, name)
        if t is None or not np.isfinite(t):
            continue
        x = x_of(float(axis.place(np.array(t))))
        if x > end:
            if glyphs:
                arrow(
                    draw,
                    ImVec2(end - 0.4 * ui.em, top + (0.5 + 0.75 * row) * ui.em),
                    0.3 * ui.em,
                    packed(ui.theme.text),
                )
            continue
        draw.add_line(ImVec2(x, top), ImVec2(x, top + implot.get_plot_size().y), packed(faded(ui.theme.text, 0.35)))
        if glyphs:
            # one below the other, because on a surface all three are at the same place
            glyph(draw, ImVec2(x, top + (0.5 + 0.75 * row) * ui.em), 0.3 * ui.em, packed(ui.theme.text))
    implot.pop_plot_clip_rect()


def pixels(t: np.ndarray) -> np.ndarray:
    """Return the screen x in pixels (N,) of distances (N,) in the current plot."""
    limits, at, size = implot.get_plot_limits().x, implot.get_plot_pos(), implot.get_plot_size()
    return (
        at.x + (t - limits.min) / max(limits.size(), 1e-12) * size.x
    )  # 1e-12: for two equal limits, where any position will do


def x_of(t: float) -> float:
    """`pixels` of one distance."""
    return float(pixels(np.array([t]))[0])


def row_of(bounds: list[float], row: int) -> tuple[float, float]:
    """Return top and bottom of a strip's row in pixels, with a small gap between rows."""
    low, high = (implot.plot_to_pixels(0.0, edge).y for edge in bounds[row : row + 2])
    air = 0.08 * abs(high - low)
    return min(low, high) + air, max(low, high) - air


def ticks(ui: Ui, t: np.ndarray, row: tuple[float, float], color: ImVec4) -> None:
    """Draw a line at each distance (S,). row: top and bottom in pixels."""
    draw, (top, bottom), tint = implot.get_plot_draw_list(), row, packed(color)
    for x in pixels(t).tolist():
        draw.add_line(ImVec2(x, top), ImVec2(x, bottom), tint, 0.06 * ui.em)


def color_strip(steps: Steps, row: tuple[float, float], opacity: np.ndarray) -> None:
    """Draw the colour of every sample over its interval of the ray. opacity: (S,) in [0, 1]."""
    draw, (top, bottom) = implot.get_plot_draw_list(), row
    left, right = pixels(steps.t).tolist(), pixels(steps.until).tolist()
    colors = tints(steps.probe.rgb, opacity)
    for i in np.flatnonzero(opacity >= 0.5 / 255).tolist():
        draw.add_rect_filled(ImVec2(left[i], top), ImVec2(right[i], bottom), colors[i])


def be_item(left: float, top: float, right: float, bottom: float) -> None:
    """Make a rectangle imgui's last item, so that `ui.mark` can mark it: the content of a plot is not an item."""
    visible = imgui.internal.ItemStatusFlags_.visible
    imgui.internal.set_last_item_data(0, 0, visible, imgui.internal.ImRect(left, top, right, bottom))
