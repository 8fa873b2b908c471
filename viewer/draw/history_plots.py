"""Plots of loss and PSNR over the steps of training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import figure, marked, tr
from nerf_core.live.messages import Snapshot

from ..ui.axes import Limits, axis_name, ticks_at

if TYPE_CHECKING:
    from ..ui.contract import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
FIRST_STEPS = 500  # first length of the steps axis; it doubles when it is full
HEIGHT_EM = 4.3


@dataclass(frozen=True)
class Curve:
    """A curve. limits: the values between first noise and a good model."""

    label: str
    mark: str
    limits: tuple[float, float]
    log: bool
    figure: str
    ticks: tuple[float, ...]


LOSS = Curve(marked("loss"), "training.loss", (1e-4, 1.0), log=True, figure=".3g", ticks=(1.0, 1e-2, 1e-4))
PSNR = Curve(marked("PSNR (dB)"), "training.psnr", (5.0, 40.0), log=False, figure=".2f", ticks=(10.0, 30.0))


class HistoryPlots:
    """Two plots with one steps axis. It doubles when training reaches its end, unless the user has moved it."""

    def __init__(self) -> None:
        self._steps = Limits()
        self._loaded = -1

    def draw(self, ui: Ui, snapshot: Snapshot) -> None:
        history = snapshot.history
        fresh = snapshot.loaded != self._loaded
        self._loaded = snapshot.loaded
        top = float(FIRST_STEPS)
        while len(history.step) and top < history.step[-1]:
            top *= 2
        self._steps.follow(0.0, top, fresh)
        implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
        implot.push_style_var(implot.StyleVar_.plot_padding, ImVec2(0.9 * ui.em, 0.3 * ui.em))  # half a tick label
        if implot.begin_aligned_plots("history"):
            self._plot(ui, LOSS, history.step, history.loss, fresh)
            self._plot(ui, PSNR, history.step, history.psnr, fresh)
            implot.end_aligned_plots()
        implot.pop_style_var(2)

    def _plot(self, ui: Ui, curve: Curve, steps: np.ndarray, values: np.ndarray, fresh: bool) -> None:
        if not implot.begin_plot(f"##{curve.mark}", ImVec2(-1, HEIGHT_EM * ui.em), PLOT):
            return
        implot.setup_axis(X1, None, implot.AxisFlags_.no_tick_labels if curve.log else 0)
        self._steps.link(X1)
        implot.setup_axis(Y1, None)
        implot.setup_axis_scale(Y1, implot.Scale_.log10 if curve.log else implot.Scale_.linear)
        implot.setup_axis_limits(Y1, *curve.limits, implot.Cond_.always if fresh else implot.Cond_.once)
        ticks_at(Y1, curve.ticks)
        color = ui.theme.accent if curve.log else ui.theme.good
        good = np.isfinite(values) & ((values > 0) if curve.log else True)  # a log axis cannot show 0
        steps, values = steps[good].astype(np.float64), values[good].astype(np.float64)
        if len(steps):
            implot.plot_line(curve.label, steps, values, implot.Spec(line_color=color, line_weight=0.1 * ui.em))
            if implot.is_plot_hovered():
                _read(ui, curve, steps, values)
        # on the right, which is free: a loss has fallen there, or a PSNR risen
        label = tr(curve.label) if curve.log else tr("{curve} over steps").format(curve=tr(curve.label))
        axis_name(ui, label, right=True, height=0.0 if curve.log else 1.0)
        implot.end_plot()
        ui.mark(curve.mark)


def _read(ui: Ui, curve: Curve, steps: np.ndarray, values: np.ndarray) -> None:
    nearest = int(np.abs(steps - implot.get_plot_mouse_pos().x).argmin())
    dot = implot.Spec(marker=implot.Marker_.circle, marker_size=0.22 * ui.em, marker_fill_color=ui.theme.text)
    implot.plot_scatter("##nearest", steps[nearest : nearest + 1], values[nearest : nearest + 1], dot)
    step, value = figure(int(steps[nearest]), ","), figure(values[nearest], curve.figure)
    imgui.set_tooltip(tr("step {step}: {curve} {value}").format(step=step, curve=tr(curve.label), value=value))
