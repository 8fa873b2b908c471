"""A ray without samples: its figures, what is lacking, and a plot of the places that the method looked at."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.common.language import figure, said, tr, trn
from nerf_core.common.text import number, triple
from nerf_core.methods import lacking
from nerf_core.probe import RayProbe

from ..model.state import AppState, SampleRef
from ..ui.axes import Limits, ticks_at
from ..ui.widgets import Row, faded, figures, hint, swatch, visit_tooltip
from .visits import Ink, discs

if TYPE_CHECKING:
    from ..ui.contract import Ui

X1, Y1 = implot.ImAxis_.x1, implot.ImAxis_.y1
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text
SIDE_EM, SIDE_NEEDS_EM = 17.0, 36.0  # width of the figures' column; the panel's width from which it is beside the plot
LOW_EM = 12.0  # height of the plot if the figures are below it
REACH_EM = 0.8  # the mouse hits a visit at this distance from it
AIR = 0.06  # of the axis: beside the first and the last place
TICKS = 5  # of the visits
INVISIBLE = 1e-6  # the shortest axis over t, in world units


class BareRay:
    """What the ray panel shows of a ray without samples."""

    def __init__(self) -> None:
        self._t = Limits()
        self._opened: tuple[object, ...] = ()

    def draw(self, ui: Ui, state: AppState, ray: RayProbe) -> None:
        """Draw into the rest of the panel. Sets `AppState.pointed_at` for the visit under the mouse."""
        if not len(ray.visited):
            _words(ui, state)
            _figures(ui, ray)
            return
        avail = imgui.get_content_region_avail()
        beside = avail.x > SIDE_NEEDS_EM * ui.em
        imgui.begin_child("visits", ImVec2(avail.x - SIDE_EM * ui.em, avail.y) if beside else ImVec2(0, LOW_EM * ui.em))
        self._plot(ui, state, ray)
        imgui.end_child()
        if beside:
            imgui.same_line(0, ui.em)
            imgui.begin_child("figures")
        _words(ui, state)
        _figures(ui, ray)
        if beside:
            imgui.end_child()

    def _plot(self, ui: Ui, state: AppState, ray: RayProbe) -> None:
        """The visits from the first, at the top, to the last, over t; a line at the depth."""
        t, count = np.nan_to_num(ray.visited.astype(np.float64)), len(ray.visited)
        order = np.arange(1, count + 1, dtype=np.float64)
        places = t if ray.depth_expected is None else np.append(t, ray.depth_expected)
        low, high = float(places.min()), float(places.max())
        air = max(AIR * (high - low), INVISIBLE)
        opened = (
            state.snapshot.loaded,
            ray.pixel,
            ray.origin.tobytes(),
            ray.direction.tobytes(),
            state.snapshot.method,
        )
        self._t.follow(low - air, high + air, opened != self._opened)
        self._opened = opened
        words = trn(
            "{n} visit, the first on top, over t (world units)",
            "{n} visits, the first on top, over t (world units)",
            count,
        )
        words += "" if ray.depth_expected is None else tr("; line: depth")
        imgui.text_colored(ui.theme.muted, words)
        if not implot.begin_plot("##visits", ImVec2(-1, -1), PLOT):
            return
        implot.setup_axis(X1, None, 0)
        self._t.link(X1)
        implot.setup_axis(Y1, None, implot.AxisFlags_.invert | implot.AxisFlags_.lock)
        implot.setup_axis_limits(Y1, 0.3, count + 0.7, implot.Cond_.always)
        ticks = range(1, count + 1, max(1, -(-(count - 1) // TICKS)))
        ticks_at(Y1, ticks)
        way = implot.Spec(line_color=faded(ui.theme.fine, 0.7), line_weight=0.1 * ui.em)
        implot.plot_line("way", t, order, way)
        if ray.depth_expected is not None:
            depth = implot.Spec(line_color=ui.theme.point, line_weight=0.1 * ui.em)
            implot.plot_inf_lines("depth", np.array([ray.depth_expected]), depth)
        corners = [implot.plot_to_pixels(x, y) for x, y in zip(t.tolist(), order.tolist(), strict=True)]
        centres = [ImVec2(at.x, at.y) for at in corners]
        hovered = self._hovered(ui, centres) if implot.is_plot_hovered() else None
        marked = hovered if hovered is not None else _marked(state, ray)
        implot.push_plot_clip_rect()
        discs(implot.get_plot_draw_list(), centres, ui.em, Ink(ui.theme.fine, ui.theme.surface, ui.theme.text), marked)
        implot.pop_plot_clip_rect()
        implot.end_plot()
        ui.mark("ray.visits")
        if hovered is not None:
            state.pointed_at = SampleRef(0, hovered)
            visit_tooltip(ui, ray, hovered)

    def _hovered(self, ui: Ui, centres: list[ImVec2]) -> int | None:
        mouse = imgui.get_mouse_pos()
        apart = [np.hypot(at.x - mouse.x, at.y - mouse.y) for at in centres]
        nearest = int(np.argmin(apart))
        return nearest if apart[nearest] < REACH_EM * ui.em else None


def _marked(state: AppState, ray: RayProbe) -> int | None:
    ref = state.sample
    return ref.at if ref is not None and ref.at < len(ray.visited) else None


def _words(ui: Ui, state: AppState) -> None:
    asked, opened = state.inspect, state.snapshot.opened
    if asked is not None and asked.id != state.snapshot.opened_id:
        x, y = (figure(v, ",") for v in asked.pixel)
        hint(ui, tr("Opening the ray through pixel {x}, {y} …").format(x=x, y=y))
    lacks = tr(lacking(opened.method if opened is not None else "", "trace"))
    lacks = lacks or tr("the method keeps no samples along a ray")
    words = tr("{lacks}: there is no σ, no w and no T, and no verdict.")
    hint(ui, words.format(lacks=f"{lacks[0].upper()}{lacks[1:]}"))
    ui.mark("ray.lacks")


def _figures(ui: Ui, ray: RayProbe) -> None:
    rows: list[Row] = [
        (tr("pixel"), f"{figure(ray.pixel[0], ',')}, {figure(ray.pixel[1], ',')}"),
        (tr("rendered"), triple(ray.rendered_color), partial(swatch, ui, ray.rendered_color)),
        (tr("opacity"), figure(ray.opacity, ".4f")),
        (tr("depth"), number(ray.depth_expected, 5)),
        ("t", f"{said(number(ray.near))} … {said(number(ray.far))}"),
    ]
    if ray.begins:
        rows.append((tr("t begins"), f"{said(number(ray.near, 3))}, {tr(ray.begins)}"))
    rows.append((tr("samples"), tr("none at step {step}").format(step=figure(ray.step, ","))))
    figures(ui, "ray figures", rows)
