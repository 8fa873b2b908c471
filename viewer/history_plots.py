"""Loss and PSNR over the steps of training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.messages import History, Snapshot

if TYPE_CHECKING:
    from viewer.panels import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
FIRST_STEPS = 500  # the steps axis starts with this many and doubles when they are full
LOSS_LIMITS, PSNR_LIMITS = (1e-4, 1.0), (5.0, 40.0)  # what trainings from first noise to a fine model pass through
HEIGHT_EM = 5.5


class HistoryPlots:
    """Both plots share the steps axis. It doubles when training runs out of it, unless the user has moved it."""

    def __init__(self) -> None:
        self._low, self._high = implot.BoxedValue(0.0), implot.BoxedValue(FIRST_STEPS)
        self._set = (0.0, float(FIRST_STEPS))  # the limits that were chosen here last
        self._loaded = -1

    def draw(self, ui: Ui, snapshot: Snapshot) -> None:
        history = snapshot.history
        fresh = snapshot.loaded != self._loaded
        self._loaded = snapshot.loaded
        self._follow(int(history.step[-1]) if len(history.step) else 0, fresh)
        implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
        if implot.begin_aligned_plots("history"):
            size = ImVec2(-1, HEIGHT_EM * ui.em)
            self._plot(ui, history, "loss", history.loss, size, LOSS_LIMITS, fresh)
            self._plot(ui, history, "PSNR (dB)", history.psnr, size, PSNR_LIMITS, fresh)
            implot.end_aligned_plots()
        implot.pop_style_var()

    def _follow(self, last: int, fresh: bool) -> None:
        untouched = (self._low.value, self._high.value) == self._set
        if not (fresh or (untouched and last > self._set[1])):
            return
        top = float(FIRST_STEPS)
        while top < last:
            top *= 2
        self._set = (0.0, top)
        self._low.value, self._high.value = self._set

    def _plot(
        self, ui: Ui, history: History, label: str, values: np.ndarray, size: ImVec2, limits: tuple[float, float], fresh: bool
    ) -> None:
        loss = label == "loss"
        if not implot.begin_plot(f"##{label}", size, PLOT):
            return
        implot.setup_axis(X1, None if loss else "steps", implot.AxisFlags_.no_tick_labels if loss else 0)
        implot.setup_axis_links(X1, self._low, self._high)
        implot.setup_axis(Y1, label)
        implot.setup_axis_scale(Y1, implot.Scale_.log10 if loss else implot.Scale_.linear)
        implot.setup_axis_limits(Y1, *limits, implot.Cond_.always if fresh else implot.Cond_.once)
        color = ui.theme.accent if loss else ui.theme.good
        good = np.isfinite(values) & ((values > 0) if loss else True)  # a log axis has no place for 0
        steps, shown = history.step[good].astype(np.float64), values[good].astype(np.float64)
        if len(steps):
            implot.plot_line(label, steps, shown, implot.Spec(line_color=color, line_weight=0.1 * ui.em))
            if implot.is_plot_hovered():
                _read(ui, label, steps, shown, color)
        implot.end_plot()
        ui.mark("training.loss" if loss else "training.psnr")


def _read(ui: Ui, label: str, steps: np.ndarray, values: np.ndarray, color: ImVec4) -> None:
    nearest = int(np.abs(steps - implot.get_plot_mouse_pos().x).argmin())
    dot = implot.Spec(marker=implot.Marker_.circle, marker_size=0.22 * ui.em, marker_fill_color=color)
    implot.plot_scatter("##nearest", steps[nearest : nearest + 1], values[nearest : nearest + 1], dot)
    figure = f"{values[nearest]:.3g}" if label == "loss" else f"{values[nearest]:.2f}"
    imgui.set_tooltip(f"step {int(steps[nearest]):,}: {label} {figure}")
