"""What the axes of plots share: names inside the plot, ticks in the window's language, limits that follow the data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import ENGLISH, figure, language

from .widgets import faded, packed

if TYPE_CHECKING:
    from .contract import Ui


def axis_name(ui: Ui, text: str, *, right: bool = False, height: float = 0.0) -> None:
    """Write an axis's name inside the plot, where it takes no space. Call it between begin and end of the plot.

    height: how far down, from 0 (the top) to 1.
    """
    at, size, extent = implot.get_plot_pos(), implot.get_plot_size(), imgui.calc_text_size(text)
    gap = 0.25 * ui.em
    x = at.x + size.x - extent.x - gap if right else at.x + gap
    y = at.y + height * (size.y - extent.y)
    draw = implot.get_plot_draw_list()
    implot.push_plot_clip_rect()
    plate = faded(implot.get_style().color_(implot.Col_.plot_bg), 0.75)
    draw.add_rect_filled(ImVec2(x - gap, y), ImVec2(x + extent.x + gap, y + extent.y), packed(plate))
    draw.add_text(ImVec2(x, y), packed(ui.theme.muted), text)
    implot.pop_plot_clip_rect()


def ticks_at(axis: int, places: Sequence[float], values: Sequence[float] | None = None) -> None:
    """Set ticks at `places` of an axis. values: what they say, where that is not the place itself."""
    shown = places if values is None else values
    implot.setup_axis_ticks(axis, list(places), [figure(v, "g") for v in shown])


def number_ticks(axis: int, low: float, high: float, least: int = 4) -> None:
    """Set an axis's ticks as the window's language writes numbers. implot itself writes English ones.

    low, high: the axis's ends. It gets `least` to 2.5 times as many ticks, at multiples of 1, 2 or 5 times a power of
    ten.
    """
    if language() == ENGLISH or not high > low:
        return
    power = 10.0 ** math.floor(math.log10((high - low) / least))
    step = next(power * m for m in (5, 2, 1) if power * m <= (high - low) / least)
    places = step * np.arange(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)  # despite rounding
    ticks_at(axis, places.tolist(), [float(f"{v:.6g}") or 0.0 for v in places])


def fitted_axes(curves: Iterable[tuple[np.ndarray, np.ndarray]], ticks: Sequence[float] | None = None) -> None:
    """Let both axes of a plot fit these curves, x (N,) and y (N,) each, with ticks in the window's language.

    ticks: those of y.
    """
    both = list(curves)
    for k, axis in enumerate((implot.ImAxis_.x1, implot.ImAxis_.y1)):
        implot.setup_axis(axis, None, implot.AxisFlags_.auto_fit)
        values = np.concatenate([curve[k] for curve in both]) if both else np.empty(0)
        values = values[np.isfinite(values)]
        if k == 1 and ticks is not None:
            ticks_at(axis, ticks)
            continue
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if not high > low:
            low, high = low - 0.5, high + 0.5  # as implot does
        number_ticks(axis, low, high, least=2)


class Limits:
    """The limits of an axis. They follow the data until the user moves them."""

    def __init__(self, low: float = 0.0, high: float = 1.0) -> None:
        self.low, self.high = implot.BoxedValue(low), implot.BoxedValue(high)
        self._set = (low, high)

    def follow(self, low: float, high: float, fresh: bool) -> None:
        """Set the limits to the data. fresh: the data is new, so that the user's limits no longer count."""
        if fresh or self.shown() == self._set:
            self.set(low, high)

    def set(self, low: float, high: float) -> None:
        """Set the limits, also where the user moved them."""
        self._set = self.low.value, self.high.value = low, high

    def shown(self) -> tuple[float, float]:
        """Return the limits as they are, perhaps moved by the user."""
        return self.low.value, self.high.value

    def link(self, axis: int, least: int | None = 4) -> None:
        """Give them to an axis of the plot that is being set up.

        least: of its `number_ticks`. None: it has none, or gets its own; implot would show both.
        """
        implot.setup_axis_links(axis, self.low, self.high)
        if least is not None:
            number_ticks(axis, *self.shown(), least)
