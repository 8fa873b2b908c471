"""The history panel: weights, colour and depth of a pinned ray over the steps of training."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.colormaps import colored
from nerf_core.common.language import figure, marked, phrases, tr
from nerf_core.live.messages import Pin
from nerf_core.methods import lacking
from nerf_core.probe import RayHistory

from ..model.state import Action, AppState, nothing_to_train_in
from ..ui.axes import Limits, axis_name
from ..ui.contract import PANELS, Ui
from ..ui.widgets import color_scale, faded, hint, packed, same_line_if_fits

COLUMNS = 320  # columns of the map: more than there are records, so that each has its own
STRIP_EM = 1.4
WORTH = 0.01  # of the largest weight: smaller weights are dark in the map
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text


@PANELS.register("ray_history")
class RayHistoryPanel:
    title = marked("Ray history")
    dock: Literal["bottom"] = "bottom"
    order = 4

    def __init__(self) -> None:
        self._of: RayHistory | None = None
        self._x, self._t = Limits(), Limits()
        self._open = (0.0, 1.0)
        self._map = self._strip = np.zeros((1, 1, 4), np.uint8)

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        yield from ()
        pin = _shown(state)
        history = pin.history if pin is not None else None
        if pin is not None and history is not None and len(history.steps) == 1:
            text = tr("{name}: its history begins at step {step}.")
            text = text.format(name=pin.name, step=figure(history.steps[0], ","))
            hint(ui, f"{text} {_outlook(state, history)}")
            return
        if pin is None or history is None:
            hint(ui, tr("Pin a ray (Ctrl+click): from then on, here is how its weights move while the model learns."))
            return
        fresh = self._of is None or history.edges is not self._of.edges  # another pin, or a new training
        if history is not self._of:
            self._of, self._map, self._strip = history, _map(history), _strip(history)
            self._open = where_weights_are(history)
        imgui.text_colored(ui.theme.pins[pin.color], pin.name)
        imgui.same_line()
        extent = phrases(
            "{n:,} record, steps {first:,} to {last:,}",
            "{n:,} records, steps {first:,} to {last:,}",
            len(history.steps),
            first=int(history.steps[0]),
            last=int(history.steps[-1]),
        )
        imgui.text_colored(ui.theme.muted, tr(extent))
        if weightless(history):
            lacks = tr(lacking(state.snapshot.method, "trace")) or tr("the method keeps no samples along a ray")
            text = tr("{lacks}: there are no weights to show, but colour and depth.")
            hint(ui, text.format(lacks=f"{lacks[0].upper()}{lacks[1:]}"))
            ui.mark("ray_history.lacks")
        else:
            _scale(ui)
        self._draw(ui, history, fresh)

    def _draw(self, ui: Ui, history: RayHistory, fresh: bool) -> None:
        room = imgui.get_content_region_avail()
        first, last = int(history.steps[0]), int(history.steps[-1])
        x = np.log1p(history.steps - first)
        end = max(float(x[-1]), 1e-6)
        self._x.follow(0.0, end, fresh)
        self._t.follow(*self._open, fresh)
        implot.push_style_var(
            implot.StyleVar_.plot_padding, ImVec2(1.8 * ui.em, 0.4 * ui.em)
        )  # half the width of a step's number
        size = ImVec2(-1, max(room.y - (STRIP_EM + 0.4) * ui.em, 5 * ui.em))
        if implot.begin_plot("##ray history", size, PLOT):
            for axis, limits, least in ((implot.ImAxis_.x1, self._x, None), (implot.ImAxis_.y1, self._t, 4)):
                implot.setup_axis(axis, None, 0)
                limits.link(axis, least)
            wide = imgui.calc_text_size(figure(last, ",")).x + ui.em
            steps = ticks(first, last, max(wide / max(room.x - 6 * ui.em, wide), 0.1))
            places = np.log1p(np.array(steps) - first).tolist()
            implot.setup_axis_ticks(implot.ImAxis_.x1, places, [figure(v, ",") for v in steps])
            unfit = implot.Spec(flags=implot.ItemFlags_.no_fit)
            low, high = implot.Point(0, float(history.edges[0])), implot.Point(end, float(history.edges[-1]))
            if not weightless(history):
                implot.plot_image("weights", ui.texture("ray history", self._map, smooth=False), low, high, spec=unfit)
            line = implot.Spec(line_color=ui.theme.text, line_weight=0.1 * ui.em, flags=implot.ItemFlags_.no_fit)
            for run in _runs(history.depth):  # gaps where there is no depth
                implot.plot_line("depth", x[run], history.depth[run].astype(np.float64), line)
            unseen = implot.Spec(line_color=faded(ui.theme.text, 0.0))
            implot.plot_line(
                "open", np.array([0.0, end]), np.array(self._open), unseen
            )  # an invisible line, so that a double click fits the axes to this range
            axis_name(ui, _depth_name(history))
            axis_name(ui, tr("step, log scale since it was pinned"), right=True, height=1.0)
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


def _shown(state: AppState) -> Pin | None:
    """The opened pin, or else the first."""
    asked, pins = state.inspect, state.snapshot.pins
    return next((pin for pin in pins if asked is not None and pin.id == asked.id), pins[0] if pins else None)


def weightless(history: RayHistory) -> bool:
    """Return whether a history is of a method without samples along a ray, and so without weights."""
    return bool(np.isnan(history.weights).all())


def _outlook(state: AppState, history: RayHistory) -> str:
    """What a history of one record will show."""
    untrainable = nothing_to_train_in(state.snapshot)
    if untrainable:
        return tr("It ends there, for there is {untrainable}.").format(untrainable=tr(untrainable))
    if weightless(history):
        return tr("Train on to see how its colour and depth move.")
    return tr("Train on to see how its weights move.")


def _runs(values: np.ndarray) -> list[slice]:
    """The stretches of a curve that are finite. implot would draw vertices that are not finite for the others."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(values), [False]]).astype(np.int8)))
    return [slice(*pair) for pair in ends.reshape(-1, 2).tolist()]


def _depth_name(history: RayHistory) -> str:
    if not weightless(history):
        return tr("t; white: median depth")
    return tr("t; white: depth") if np.isfinite(history.depth).any() else tr("t; there is no depth")


def _columns(history: RayHistory) -> np.ndarray:
    """The newest record (COLUMNS,) at each column of an axis that is uniform in log(1 + step)."""
    x = np.log1p((history.steps - history.steps[0]).astype(np.float64))
    at = np.linspace(0, x[-1], COLUMNS)
    return np.clip(np.searchsorted(x, at + 1e-9, side="right") - 1, 0, len(x) - 1)


def _map(history: RayHistory) -> np.ndarray:
    """The map (BINS, COLUMNS, 4) uint8, far at the top: the square root of each bin's weight, so that fog shows."""
    weights = history.weights[_columns(history)].T[::-1]
    rgb = colored(np.sqrt(np.clip(weights, 0, 1)), 0, 1)
    return _rgba(rgb)


def _strip(history: RayHistory) -> np.ndarray:
    return _rgba(np.clip(history.color[_columns(history)], 0, 1)[None])


def _rgba(rgb: np.ndarray) -> np.ndarray:
    rgba = np.concatenate([rgb, np.ones((*rgb.shape[:-1], 1))], -1)
    return np.ascontiguousarray((np.nan_to_num(rgba) * 255 + 0.5).astype(np.uint8))


def where_weights_are(history: RayHistory) -> tuple[float, float]:
    """Return the part of the ray, with a margin, in which any record has visible weight; without weights, a depth."""
    edges, depths = history.edges, history.depth[np.isfinite(history.depth)]
    heavy = np.flatnonzero((history.weights > WORTH * history.weights.max()).any(0))
    if weightless(history) and len(depths):
        low, high = float(depths.min()), float(depths.max())
    elif len(heavy):
        low, high = float(edges[heavy[0]]), float(edges[heavy[-1] + 1])
    else:
        return float(edges[0]), float(edges[-1])
    margin = max(0.1 * (high - low), 3 * float(edges[1] - edges[0]))
    return max(low - margin, float(edges[0])), min(high + margin, float(edges[-1]))


def ticks(first: int, last: int, apart: float) -> list[int]:
    """Choose the steps to label on an axis that is uniform in log(1 + steps since the first).

    They are the first, the last, and the roundest between them that are at least `apart` of the axis apart.
    """
    whole = max(math.log1p(last - first), 1e-6)
    decades = [10**k for k in range(len(str(last)), -1, -1)]
    candidates = [first]
    for unit in (factor * decade for factor in (1, 5, 2) for decade in decades):
        if unit >= 0.01 * first:  # finer numbers do not look round beside the first step
            begin = (first // unit + 1) * unit
            candidates += range(begin, min(begin + 10 * unit, last), unit)
    found = {last: 1.0}
    for step in candidates:
        at = math.log1p(step - first) / whole
        if all(abs(at - other) >= apart for other in found.values()):
            found[step] = at
    return sorted(found)


def _scale(ui: Ui) -> None:
    """The colour scale of the map."""
    words, width = (f"  {tr('weight in a bin')}  0", f"1  {tr('(square root)')}"), 6 * ui.em
    same_line_if_fits("".join(words), width)
    imgui.text_colored(ui.theme.muted, words[0])
    imgui.same_line()
    at, high = imgui.get_cursor_screen_pos(), imgui.get_text_line_height()
    low, far = ImVec2(at.x, at.y + 0.15 * high), ImVec2(at.x + width, at.y + 0.85 * high)
    color_scale(imgui.get_window_draw_list(), low, far)
    imgui.dummy(ImVec2(width, high))
    imgui.same_line()
    imgui.text_colored(ui.theme.muted, words[1])


def _tooltip(history: RayHistory, x: np.ndarray, at: float) -> None:
    k = int(
        np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 1)
    )  # the map shows a record up to the next one
    depth = history.depth[k]
    text = tr("step {step}: no depth, opacity {opacity}")
    if np.isfinite(depth):
        text = tr("step {step}: depth {depth}, opacity {opacity}")
    step, opacity = figure(history.steps[k], ","), figure(history.opacity[k], ".3f")
    imgui.set_tooltip(text.format(step=step, depth=figure(depth, ".4g"), opacity=opacity))
