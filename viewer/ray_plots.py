"""One ray drawn over t: weights and transmittance, density, sample positions and colours, on one shared axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.probe import PassProbe, RayProbe
from viewer.widgets import color_of, faded, packed

if TYPE_CHECKING:
    from viewer.panels import Ui

X1, Y1, Y2 = implot.ImAxis_.x1, implot.ImAxis_.y1, implot.ImAxis_.y2
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
LOG_DECADES = 4  # how far below its peak density is still told from empty space on a log axis
DRAG_ID = 0

Glyph = Callable[[imgui.ImDrawList, ImVec2, float, int], None]


def triangle(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_triangle_filled(ImVec2(at.x - r, at.y - r), ImVec2(at.x + r, at.y - r), ImVec2(at.x, at.y + r), color)


def diamond(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_ngon_filled(at, 1.2 * r, color, 4)


def circle(draw: imgui.ImDrawList, at: ImVec2, r: float, color: int) -> None:
    draw.add_circle(at, r, color, thickness=0.4 * r)


DEPTHS: tuple[tuple[str, str, Glyph], ...] = (
    ("expected", "depth_expected", triangle),
    ("median", "depth_median", diamond),
    ("strongest", "depth_strongest", circle),
)


@dataclass(frozen=True)
class Steps:
    """One pass as stairs: value i holds from edge i to edge i + 1, (S + 1,) each, the last value repeated."""

    probe: PassProbe
    edges: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    transmittance: np.ndarray  # at the edges; the last is what passes the whole ray


def steps_of(ray: RayProbe) -> tuple[Steps, ...]:
    """The passes that hold samples. The last sample of a ray reaches to its far end."""
    return tuple(_steps(p, ray.far) for p in ray.passes if len(p.t))


def _steps(p: PassProbe, far: float) -> Steps:
    edges = np.append(p.t, max(far, float(p.t[-1]))).astype(np.float64)
    left = np.append(p.transmittance, p.transmittance[-1] * (1 - p.alpha[-1]))
    clean = [np.nan_to_num(v).astype(np.float64) for v in (_hold(p.weights), _hold(p.sigma), left)]
    return Steps(p, np.nan_to_num(edges), *clean)


def _hold(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[-1])


def wants_log(sigma: np.ndarray) -> bool:
    """Whether a linear axis would flatten most of the density: its peak stands 50 times over its median."""
    positive = sigma[sigma > 0]
    return len(positive) > 0 and bool(positive.max() > 50 * np.median(positive))


class RayPlots:
    """Three plots over a shared t axis whose limits are set when another ray is opened, and by the user alone after."""

    def __init__(self) -> None:
        self.log_density = False
        self.hovered: tuple[Steps, int] | None = None
        self._t_min, self._t_max = implot.BoxedValue(0.0), implot.BoxedValue(1.0)
        self._weight_top = 1.0
        self._sigma_limits = (0.0, 1.0)
        self._fresh_weights = self._fresh_density = True
        self._dragged: float | None = None

    def open(self, ray: RayProbe, passes: tuple[Steps, ...]) -> None:
        """Choose limits and scale for a ray that was just opened."""
        span = max(ray.far - ray.near, 1e-6)  # a ray without length still needs an axis
        self._t_min.value, self._t_max.value = ray.near - 0.01 * span, ray.near + 1.01 * span
        self._weight_top = 1.2 * max([float(p.weights.max()) for p in passes], default=0.0) or 1.0
        self.log_density = bool(passes) and wants_log(passes[-1].sigma)
        self._dragged = None
        self.scale_density(passes)
        self._fresh_weights = True

    def scale_density(self, passes: tuple[Steps, ...]) -> None:
        top = max([float(p.sigma.max()) for p in passes], default=0.0) or 1.0
        self._sigma_limits = (top * 10.0**-LOG_DECADES, 3 * top) if self.log_density else (0.0, 1.2 * top)
        self._fresh_density = True

    def draw(self, ui: Ui, ray: RayProbe, passes: tuple[Steps, ...], point_t: float | None, units: str, size: ImVec2) -> float | None:
        """Draw everything into `size`. Returns the t to which the user drags the radiance point, else None.

        units: of length in density's 1/length: "unit" or "NDC unit".
        """
        pad = 0.25 * ui.em
        implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
        implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(pad, pad))
        implot.push_style_var(implot.StyleVar_.label_padding, ImVec2(pad, pad))
        reading, dragged = None, None
        strip = (len(passes) + 2) * 0.75 * ui.em + 2 * pad
        spacing = 2 * imgui.get_style().item_spacing.y
        axis = 2 * imgui.get_text_line_height() + 2 * pad  # the density plot also carries the t axis
        height = max((size.y - strip - axis - spacing) / 2, 3 * ui.em)
        if implot.begin_aligned_plots("ray"):
            point = self._dragged if self._dragged is not None else point_t
            for plot, plot_height in ((self._weights, height), (self._density, height + axis)):
                moved, read = plot(ui, ray, passes, point, units, ImVec2(size.x, plot_height))
                dragged, reading = moved if moved is not None else dragged, read or reading
            reading = self._strip(ui, passes, ImVec2(size.x, strip)) or reading
            implot.end_aligned_plots()
        implot.pop_style_var(3)
        self.hovered = reading
        if dragged is None:
            if not imgui.is_mouse_down(imgui.MouseButton_.left):
                self._dragged = None
            return None
        self._dragged = float(np.clip(dragged, ray.near, ray.far))
        return self._dragged

    def _weights(
        self, ui: Ui, ray: RayProbe, passes: tuple[Steps, ...], point: float | None, units: str, size: ImVec2
    ) -> tuple[float | None, tuple[Steps, int] | None]:
        if not implot.begin_plot("##weights", size, PLOT):
            return None, None
        self._share_t(None, implot.AxisFlags_.no_tick_labels)
        implot.setup_axis(Y1, "w")
        implot.setup_axis_limits(Y1, 0, self._weight_top, _when(self._fresh_weights))
        implot.setup_axis_limits_constraints(Y1, 0, 1.2)
        implot.setup_axis(Y2, "T", implot.AxisFlags_.aux_default | implot.AxisFlags_.lock)
        implot.setup_axis_limits(Y2, 0, 1.05, implot.Cond_.always)
        implot.setup_axis_ticks(Y2, [0.0, 0.5, 1.0], ["0", "0.5", "1"])
        self._fresh_weights = False
        for steps in passes[-1:]:
            filled = implot.Spec(fill_color=faded(ui.theme.fine, 0.55), flags=implot.StairsFlags_.shaded)
            filled.line_color = ui.theme.fine
            implot.plot_stairs("fine weight", steps.edges, steps.weights, filled)
        for steps in passes[:-1]:
            outline = implot.Spec(line_color=ui.theme.coarse, line_weight=0.1 * ui.em)
            implot.plot_stairs(f"{steps.probe.name} weight", steps.edges, steps.weights, outline)
        for steps in passes[-1:]:
            implot.set_axes(X1, Y2)
            line = implot.Spec(line_color=ui.theme.transmittance, line_weight=0.12 * ui.em)
            implot.plot_line("transmittance", steps.edges, steps.transmittance, line)
            implot.set_axes(X1, Y1)
        self._clipped_note(ui, passes)
        self._depth_marks(ui, ray, glyphs=True)
        result = self._drag_point(ui, point), self._read(ui, passes)
        implot.end_plot()
        ui.mark("ray.weights")
        return result

    def _density(
        self, ui: Ui, ray: RayProbe, passes: tuple[Steps, ...], point: float | None, units: str, size: ImVec2
    ) -> tuple[float | None, tuple[Steps, int] | None]:
        if not implot.begin_plot("##density", size, PLOT):
            return None, None
        self._share_t("t (world units)", implot.AxisFlags_.none)
        implot.setup_axis(Y1, f"σ (1/{units})")
        low, high = self._sigma_limits
        implot.setup_axis_scale(Y1, implot.Scale_.log10 if self.log_density else implot.Scale_.linear)
        implot.setup_axis_limits(Y1, low, high, _when(self._fresh_density))
        self._fresh_density = False
        for steps in passes:
            last = steps is passes[-1]
            # a log axis has no place for 0: empty space lies on its floor
            sigma = np.maximum(steps.sigma, low) if self.log_density else steps.sigma
            color = ui.theme.density if last else ui.theme.coarse
            line = implot.Spec(line_color=color, line_weight=(0.12 if last else 0.08) * ui.em)
            implot.plot_stairs(f"{steps.probe.name} density", steps.edges, sigma, line)
        self._depth_marks(ui, ray, glyphs=False)
        result = self._drag_point(ui, point), self._read(ui, passes)
        implot.end_plot()
        ui.mark("ray.density")
        return result

    def _strip(self, ui: Ui, passes: tuple[Steps, ...], size: ImVec2) -> tuple[Steps, int] | None:
        """Where each pass placed its samples, what colour those of the last have, and what each of them paints."""
        if not implot.begin_plot("##strip", size, PLOT):
            return None
        rows = [*(s.probe.name for s in passes), "colour", "× weight"]
        self._share_t(None, implot.AxisFlags_.no_decorations)
        implot.setup_axis(Y1, None, implot.AxisFlags_.lock | implot.AxisFlags_.invert | implot.AxisFlags_.no_grid_lines)
        implot.setup_axis_limits(Y1, 0, len(rows), implot.Cond_.always)
        implot.setup_axis_ticks(Y1, [i + 0.5 for i in range(len(rows))], rows)
        implot.setup_finish()
        implot.push_plot_clip_rect()
        for row, steps in enumerate(passes):
            last = steps is passes[-1]
            _ticks(ui, steps.edges[:-1], row, ui.theme.fine if last else ui.theme.coarse)
        for steps in passes[-1:]:
            _colors(steps, len(passes), np.ones(len(steps.probe.t)))
            _colors(steps, len(passes) + 1, steps.weights[:-1] / max(float(steps.weights.max()), 1e-12))  # all zero: all clear
        implot.pop_plot_clip_rect()
        reading = None
        if implot.is_plot_hovered():
            row = int(np.clip(implot.get_plot_mouse_pos().y, 0, len(rows) - 1))
            reading = self._read(ui, passes[row : row + 1] or passes[-1:])
        implot.end_plot()
        ui.mark("ray.strip")
        return reading

    def _share_t(self, label: str | None, flags: implot.AxisFlags_) -> None:
        implot.setup_axis(X1, label, flags)
        implot.setup_axis_links(X1, self._t_min, self._t_max)

    def _drag_point(self, ui: Ui, point: float | None) -> float | None:
        if point is None:
            return None
        changed, t, *_ = implot.drag_line_x(DRAG_ID, point, ui.theme.accent, 0.15 * ui.em, implot.DragToolFlags_.no_fit)
        return t if changed else None

    def _depth_marks(self, ui: Ui, ray: RayProbe, *, glyphs: bool) -> None:
        draw, top = implot.get_plot_draw_list(), implot.get_plot_pos().y
        implot.push_plot_clip_rect()
        for _, name, glyph in DEPTHS:
            t = getattr(ray, name)
            if t is None or not np.isfinite(t):
                continue
            x = _x(t)
            draw.add_line(ImVec2(x, top), ImVec2(x, top + implot.get_plot_size().y), packed(faded(ui.theme.text, 0.35)))
            if glyphs:
                glyph(draw, ImVec2(x, top + 0.5 * ui.em), 0.3 * ui.em, packed(ui.theme.text))
        implot.pop_plot_clip_rect()

    def _clipped_note(self, ui: Ui, passes: tuple[Steps, ...]) -> None:
        """Training may lift a peak out of limits that stay where they are: say so, and how to see it."""
        peak = max((float(p.weights.max()) for p in passes), default=0.0)
        limits = implot.get_plot_limits(X1, Y1).y
        if peak > limits.max:
            at = implot.get_plot_pos()
            text = f"peak w = {peak:.3f}: double click to fit"
            color = packed(ui.theme.warning)
            implot.get_plot_draw_list().add_text(ImVec2(at.x + 0.5 * ui.em, at.y + 0.2 * ui.em), color, text)

    def _read(self, ui: Ui, passes: tuple[Steps, ...]) -> tuple[Steps, int] | None:
        """The sample nearest to the mouse, of whichever pass; it is also marked in this plot while it is read."""
        if self.hovered is not None:
            steps, index = self.hovered
            x = _x(float(steps.edges[index]))
            top, height = implot.get_plot_pos().y, implot.get_plot_size().y
            implot.get_plot_draw_list().add_line(ImVec2(x, top), ImVec2(x, top + height), packed(ui.theme.text))
        if not implot.is_plot_hovered() or not passes:
            return None
        t = implot.get_plot_mouse_pos().x
        nearest = [(steps, int(np.abs(steps.edges[:-1] - t).argmin())) for steps in passes]
        return min(nearest, key=lambda hit: abs(float(hit[0].edges[hit[1]]) - t))


def _when(fresh: bool) -> implot.Cond_:
    return implot.Cond_.always if fresh else implot.Cond_.once


def _pixels(t: np.ndarray) -> np.ndarray:
    limits, at, size = implot.get_plot_limits().x, implot.get_plot_pos(), implot.get_plot_size()
    return at.x + (t - limits.min) / max(limits.size(), 1e-12) * size.x  # two equal limits: any place will do


def _x(t: float) -> float:
    return float(_pixels(np.array([t]))[0])


def _row(row: int) -> tuple[float, float]:
    """Top and bottom of a strip's row in pixels, with a little air between rows."""
    low, high = implot.plot_to_pixels(0.0, row + 0.08).y, implot.plot_to_pixels(0.0, row + 0.92).y
    return min(low, high), max(low, high)


def _ticks(ui: Ui, t: np.ndarray, row: int, color: ImVec4) -> None:
    draw, (top, bottom), tint = implot.get_plot_draw_list(), _row(row), packed(color)
    for x in _pixels(t).tolist():
        draw.add_line(ImVec2(x, top), ImVec2(x, bottom), tint, 0.06 * ui.em)


def _colors(steps: Steps, row: int, opacity: np.ndarray) -> None:
    draw, (top, bottom), x = implot.get_plot_draw_list(), _row(row), _pixels(steps.edges).tolist()
    for i, (rgb, alpha) in enumerate(zip(steps.probe.rgb, np.nan_to_num(opacity).tolist(), strict=True)):
        if alpha > 0.002:  # below half an 8-bit level nothing would be seen
            draw.add_rect_filled(ImVec2(x[i], top), ImVec2(x[i + 1], bottom), packed(color_of(rgb, alpha)))
