"""How a pinned ray came to be what it is: its weights, colour and depth over the steps of training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.colormaps import colored
from nerf_core.probe import RayHistory
from viewer.panels import PANELS, Ui
from viewer.state import Action, AppState, PinnedRay
from viewer.widgets import axis_name, hint, packed

COLUMNS = 320  # of the map: more than records, so that each keeps its place
STRIP_EM = 1.4
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text


@PANELS.register("ray_history")
class RayHistoryPanel:
    title = "Ray history"
    dock: Literal["bottom"] = "bottom"
    order = 4

    def __init__(self) -> None:
        self._of: RayHistory | None = None
        self._map = self._strip = np.zeros((1, 1, 4), np.uint8)

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        yield from ()
        pin = _shown(state)
        histories = {one.id: one.history for one in state.snapshot.pinned}
        history = histories.get(pin.id) if pin is not None else None
        if pin is not None and history is not None and len(history.steps) == 1:
            hint(
                ui,
                f"{pin.name}: its history begins at step {history.steps[0]:,}. Train on to see how its weights move.",
            )
            return
        if pin is None or history is None:
            hint(ui, "Pin a ray (Ctrl+click): from then on, here is how its weights move while the model learns.")
            return
        if history is not self._of:
            self._of, self._map, self._strip = history, _map(history), _strip(history)
        imgui.text_colored(ui.theme.pins[pin.color], pin.name)
        imgui.same_line()
        imgui.text_colored(ui.theme.muted, f"{len(history.steps):,} records, steps {history.steps[0]:,} to "
                           f"{history.steps[-1]:,}; brighter: more of the bin's weight")  # fmt: skip
        self._draw(ui, history)

    def _draw(self, ui: Ui, history: RayHistory) -> None:
        room = imgui.get_content_region_avail()
        first, last = float(history.steps[0]), float(history.steps[-1])
        x = np.log1p(history.steps - first)
        end = max(float(x[-1]), 1e-6)
        implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(1.2 * ui.em, 0.4 * ui.em))
        size = ImVec2(-1, max(room.y - (STRIP_EM + 0.4) * ui.em, 5 * ui.em))
        if implot.begin_plot("##ray history", size, PLOT):
            implot.setup_axis(implot.ImAxis_.x1, None, 0)
            implot.setup_axis(implot.ImAxis_.y1, None, 0)
            low, high = float(history.edges[0]), float(history.edges[-1])
            implot.setup_axes_limits(0, end, low, high, implot.Cond_.once)
            ticks = _ticks(last - first)
            implot.setup_axis_ticks(implot.ImAxis_.x1, np.log1p(ticks).tolist(), [f"{first + v:,.0f}" for v in ticks])
            implot.plot_image("weights", ui.texture("ray history", self._map, smooth=False),
                              implot.Point(0, low), implot.Point(end, high))  # fmt: skip
            known = np.isfinite(history.depth)
            line = implot.Spec(line_color=ui.theme.text, line_weight=0.1 * ui.em)
            implot.plot_line("depth", x[known], history.depth[known].astype(np.float64), line)
            axis_name(ui, "t; white: median depth")
            if implot.is_plot_hovered():
                _tooltip(history, x, implot.get_plot_mouse_pos().x)
            left, width = implot.get_plot_pos().x, implot.get_plot_size().x
            implot.end_plot()
            ui.mark("ray_history.map")
            at = imgui.get_cursor_screen_pos()
            low_corner, high_corner = ImVec2(left, at.y), ImVec2(left + width, at.y + STRIP_EM * ui.em)
            draw = imgui.get_window_draw_list()
            draw.add_image(ui.texture("ray colours", self._strip, smooth=False), low_corner, high_corner)
            draw.add_rect(low_corner, high_corner, packed(ui.theme.hairline))
            imgui.dummy(ImVec2(width, STRIP_EM * ui.em))
        implot.pop_style_var()


def _shown(state: AppState) -> PinnedRay | None:
    """The pin that is open, else the first."""
    asked = state.inspect
    for pin in state.pins:
        if asked is not None and pin.ray.camera is asked.camera and pin.ray.pixel == asked.pixel:
            return pin
    return state.pins[0] if state.pins else None


def _columns(history: RayHistory) -> np.ndarray:
    """(COLUMNS,) the newest record at each place of an axis that is even in log(1 + step)."""
    x = np.log1p((history.steps - history.steps[0]).astype(np.float64))
    at = np.linspace(0, x[-1], COLUMNS)
    return np.clip(np.searchsorted(x, at + 1e-9, side="right") - 1, 0, len(x) - 1)


def _map(history: RayHistory) -> np.ndarray:
    """(BINS, COLUMNS, 4) uint8, far at the top: the root of each bin's weight, which lets faint fog be seen."""
    weights = history.weights[_columns(history)].T[::-1]
    rgb = colored(np.sqrt(np.clip(weights, 0, 1)), 0, 1)
    return _rgba(rgb)


def _strip(history: RayHistory) -> np.ndarray:
    return _rgba(np.clip(history.color[_columns(history)], 0, 1)[None])


def _rgba(rgb: np.ndarray) -> np.ndarray:
    rgba = np.concatenate([rgb, np.ones((*rgb.shape[:-1], 1))], -1)
    return np.ascontiguousarray((np.nan_to_num(rgba) * 255 + 0.5).astype(np.uint8))


def _ticks(span: float) -> np.ndarray:
    """0, 1, 10, 100 … up to `span`."""
    return np.array([0.0, *(10.0**k for k in range(7) if 10**k <= span)])


def _tooltip(history: RayHistory, x: np.ndarray, at: float) -> None:
    k = int(np.clip(np.searchsorted(x, at), 0, len(x) - 1))
    depth = history.depth[k]
    where = f"depth {depth:.4g}" if np.isfinite(depth) else "no depth"
    imgui.set_tooltip(f"step {history.steps[k]:,}: {where}, opacity {history.opacity[k]:.3f}")
