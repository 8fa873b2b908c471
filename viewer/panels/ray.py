"""The ray panel: why a pixel has its colour, with everything that was composited along its ray."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import digits, figure, marked, phrase, tr
from nerf_core.common.text import number, triple
from nerf_core.methods import lacking
from nerf_core.probe import RayProbe
from nerf_core.probe.axis import MET, PLAIN, Axis, chosen_axis, contracted_axis, weighty_part

from ..draw.bare_ray import BareRay
from ..draw.plot_marks import DEPTHS, Glyph
from ..draw.ray_plots import LogChoice, Opened, RayPlots
from ..draw.ray_steps import Steps, placed, steps_of
from ..model.state import Action, AppState, SampleRef, SetPointDepth
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Row, faded, figures, hint, nothing_yet, packed, same_line_if_fits, sample_tooltip, swatch

BEYOND = 0.01  # weight beyond the end of the axis that is mentioned
SIDE_EM, SIDE_NEEDS_EM = 17.0, 36.0  # width of the figures' column; the panel's width from which it is beside the plots
LOG_CHOICES: tuple[tuple[LogChoice, str, str], ...] = (
    ("auto", marked("auto"), marked("a log axis where a linear one would flatten most of this ray's density")),
    ("on", marked("on"), marked("a log axis for every ray")),
    ("off", marked("off"), marked("a linear axis for every ray")),
)
OVERVIEW_EM = 1.0  # height of the strip of the whole ray
OVERVIEW = marked(
    "the whole ray; the frame is the part shown above. Click to show all of it, or the part with the weight"
)
TO_INFINITY = marked(
    "the whole ray to infinity, over contracted distance; the frame is the part shown above. Click to show all of it, "
    "or the part with the weight"
)
CONTRACTED = marked("contracted distance")
LOW_EM = 18.0  # height of the plots if the figures are below them


@PANELS.register("ray")
class RayPanel:
    title = marked("Ray")
    dock: Literal["bottom"] = "bottom"
    order = 0

    def __init__(self) -> None:
        self.plots, self._bare = RayPlots(), BareRay()
        self._probe: RayProbe | None = None
        self._passes: tuple[Steps, ...] = ()
        self._axis = PLAIN
        self._part = (0.0, 1.0)  # the places between which the ray has weight
        self._opened: tuple[object, ...] = ()

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        ray = state.snapshot.ray
        if ray is None:
            nothing_yet(ui, state.snapshot.method, _nothing_yet(state), ())
            return
        if not ray.passes:
            self._bare.draw(ui, state, ray)
            return
        self._take(ray, state)
        avail = imgui.get_content_region_avail()
        beside, scene = avail.x > SIDE_NEEDS_EM * ui.em, state.snapshot.scene
        contracts = scene is not None and contracted_axis(ray, scene) is not None
        size = ImVec2(avail.x - SIDE_EM * ui.em, avail.y) if beside else ImVec2(avail.x, LOW_EM * ui.em)
        imgui.begin_child("plots", size)
        t = self._draw_plots(ui, state, ray)
        imgui.end_child()
        if beside:
            imgui.same_line(0, ui.em)
            imgui.begin_group()
            imgui.begin_child("figures", ImVec2(0, -(1 + contracts) * imgui.get_frame_height_with_spacing()))
        self._draw_figures(ui, state, ray)
        if beside:
            imgui.end_child()
        self._draw_choices(ui, state, contracts)  # below the figures, which scroll under a long verdict
        if beside:
            imgui.end_group()
        if self.plots.hovered is not None:
            steps, index = self.plots.hovered
            state.pointed_at = SampleRef(next(k for k, p in enumerate(ray.passes) if p is steps.probe), index)
            sample_tooltip(ui, steps.probe, index)
        if t is not None:
            yield SetPointDepth(t)

    def _take(self, ray: RayProbe, state: AppState) -> None:
        scene = state.snapshot.scene
        opened = (state.snapshot.loaded, ray.pixel, ray.origin.tobytes(), ray.direction.tobytes(), state.axis)
        if ray is self._probe and opened == self._opened:
            return
        anew, self._probe, self._opened = opened != self._opened, ray, opened
        if anew:  # the same ray at a later step keeps its axes
            finite = tuple(replace(p, weights=np.nan_to_num(p.weights)) for p in ray.passes)
            part = weighty_part(ray, finite, scene.radius if scene is not None else 1.0, _point_t(state, ray))
            self._axis = PLAIN if scene is None else chosen_axis(ray, scene, state.axis, part)
            self._part = tuple(self._axis.place(np.array(part)).tolist())
        self._passes = tuple(placed(steps, self._axis) for steps in steps_of(ray))
        if anew:
            self.plots.open(self._passes, *self._part)

    def _draw_plots(self, ui: Ui, state: AppState, ray: RayProbe) -> float | None:
        self._legend(ui)
        scene = state.snapshot.scene
        opened = Opened(
            ray,
            self._passes,
            self._axis,
            units="NDC unit" if scene is not None and scene.ndc is not None else "unit",
            point_t=_point_t(state, ray),
            marked=self._marked(state, ray),
        )
        room = imgui.get_content_region_avail()
        dragged = self.plots.draw(ui, opened, ImVec2(room.x, room.y - OVERVIEW_EM * ui.em))
        if scene is not None:
            self._overview(ui, ray, contracted_axis(ray, scene) or PLAIN)
        return dragged

    def _overview(self, ui: Ui, ray: RayProbe, axis: Axis) -> None:
        """The whole ray as a thin strip: where it has weight, and the part that the plots show. A click shows all."""
        at, wide = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x
        high = 0.5 * ui.em
        if imgui.invisible_button("overview", ImVec2(max(wide, 1.0), OVERVIEW_EM * ui.em)):
            ends = self._axis.place(np.array([ray.near, ray.far])).tolist()
            self.plots.show(*(self._part if self.plots.shows(*ends) else ends))
        ui.mark("ray.overview")
        imgui.set_item_tooltip(tr(OVERVIEW if axis.turn is None else TO_INFINITY))
        low, end = axis.place(np.array([ray.near, ray.far if axis.turn is None else np.inf])).tolist()

        def x(t: np.ndarray) -> list[float]:
            return (at.x + np.clip((axis.place(t) - low) / max(end - low, 1e-12), 0, 1) * wide).tolist()

        draw, top = imgui.get_window_draw_list(), at.y + 0.25 * ui.em
        draw.add_rect_filled(ImVec2(at.x, top), ImVec2(at.x + wide, top + high), packed(ui.theme.hairline))
        last = ray.last
        share = np.nan_to_num(last.weights) / max(float(np.nan_to_num(last.weights).max(initial=0.0)), 1e-12)
        for begin, finish, part in zip(x(last.t), x(last.until), share.tolist(), strict=True):
            if part > 0.01:
                corner = ImVec2(max(finish, begin + 1), top + high)
                draw.add_rect_filled(ImVec2(begin, top + (1 - part) * high), corner, packed(ui.theme.fine))
        left, right = x(self._axis.distance(np.maximum(np.array(self.plots.shown()), 0.0)))
        corners = ImVec2(left, top - 0.1 * ui.em), ImVec2(max(right, left + 0.2 * ui.em), top + high + 0.1 * ui.em)
        draw.add_rect(*corners, packed(ui.theme.text), thickness=max(1.0, 0.08 * ui.em))

    def _marked(self, state: AppState, ray: RayProbe) -> tuple[Steps, int] | None:
        ref = state.sample
        if ref is None or ref.one >= len(ray.passes):
            return None
        steps = next((s for s in self._passes if s.probe is ray.passes[ref.one]), None)
        return (steps, ref.at) if steps is not None and ref.at < len(steps.t) else None

    def _legend(self, ui: Ui) -> None:
        entries = [(_weights_of(s), "box", ui.theme.coarse) for s in self._passes[:-1]]
        entries += [(_weights_of(s), "filled", ui.theme.fine) for s in self._passes[-1:]]
        entries += [
            ("T", "line", ui.theme.transmittance),
            ("α", "line", ui.theme.alpha),
            ("σ", "line", ui.theme.density),
        ]
        entries.append((tr("point"), "bar", ui.theme.point))
        for i, (label, shape, color) in enumerate(entries):
            if i:
                same_line_if_fits(f"   {label}")
            _key(ui, shape, packed(color), packed(faded(color, 0.55)))
            imgui.same_line(0, 0.3 * ui.em)
            imgui.text_colored(ui.theme.muted, label)
        over = tr("over t (world units)")
        if self._axis.turn is not None:
            over = tr("over contracted t (world units)")
        same_line_if_fits(over)
        imgui.text_colored(ui.theme.muted, over)

    def _draw_figures(self, ui: Ui, state: AppState, ray: RayProbe) -> None:
        asked = state.inspect
        if asked is not None and asked.id != state.snapshot.opened_id:
            hint(ui, _opening(asked.pixel))
        _verdict(ui, state)
        last = ray.last
        beyond = float(last.weights[last.t > ray.far].sum())
        if beyond > BEYOND:
            text = tr("{share} of the pixel comes from farther than the plot shows.")
            hint(ui, text.format(share=figure(beyond, ".0%")))
        difference = float(np.abs(ray.color - ray.rendered_color).max())
        rows: list[Row] = [
            (tr("pixel"), ", ".join(figure(place, ",") for place in ray.pixel)),
            (tr("composited"), triple(ray.color), partial(swatch, ui, ray.color)),
            (tr("rendered"), triple(ray.rendered_color), partial(swatch, ui, ray.rendered_color)),
            (tr("difference"), number(difference, 2)),
            (tr("opacity"), figure(ray.opacity, ".4f")),
        ]
        for label, name, glyph in DEPTHS:
            depth = number(getattr(ray, name), 5)
            if name == "depth_expected" and ray.opacity < MET:
                depth = phrase("{depth} of {opacity:.0%}", depth=depth, opacity=ray.opacity)
            rows.append((tr(label), depth, partial(_glyph, ui, glyph)))
        if ray.begins:
            rows.append((tr("t begins"), f"{tr(number(ray.near, 3))}, {tr(ray.begins)}"))
        counts = digits(" + ".join(f"{len(p.t):,}" for p in ray.passes))
        rows.append((tr("samples"), phrase("{counts} at step {step:,}", counts=counts, step=ray.step)))
        figures(ui, "ray figures", rows)

    def _draw_choices(self, ui: Ui, state: AppState, contracts: bool) -> None:
        imgui.align_text_to_frame_padding()
        imgui.text_colored(ui.theme.muted, tr("log σ"))
        for choice, label, tip in LOG_CHOICES:
            imgui.same_line()
            if imgui.radio_button(f"{tr(label)}###log {choice}", self.plots.log_choice == choice):
                self.plots.choose_log(choice, self._passes)
            ui.mark(f"ray.log {choice}")
            imgui.set_item_tooltip(tr(tip))
        if contracts:
            changed, contracted = imgui.checkbox(f"{tr(CONTRACTED)}###contracted", self._axis.turn is not None)
            if changed:
                state.axis = "contracted" if contracted else "t"
            ui.mark("ray.contracted")
            imgui.set_item_tooltip(tr("the axis runs to infinity: far distances come closer together, as in a grid"))


def _verdict(ui: Ui, state: AppState) -> None:
    """The verdict on the pixel: a word and a sentence."""
    verdict = state.snapshot.opened.verdict if state.snapshot.opened is not None else None
    if verdict is None:
        hint(ui, tr("Asking the photos …"))
        return
    theme = ui.theme
    tones = {"good": theme.good, "neutral": theme.text, "warning": theme.warning, "error": theme.error}
    imgui.push_font(None, 1.15 * ui.em)
    imgui.text_colored(tones[verdict.tone], tr(verdict.kind).capitalize())
    imgui.pop_font()
    ui.mark("ray.verdict")
    for reason in map(tr, verdict.reasons):
        hint(ui, f"{reason[0].upper()}{reason[1:]}.", ui.theme.text)


def _weights_of(steps: Steps) -> str:
    largest = tr(number(float(steps.weights.max()), 2))
    return tr("{name} w up to {largest}").format(name=tr(steps.probe.name), largest=largest)


def _nothing_yet(state: AppState) -> str:
    if state.inspect is not None:
        return _opening(state.inspect.pixel)
    lacks = tr(lacking(state.snapshot.method, "trace"))
    if lacks:
        text = tr("Click a pixel: here you will see what is known of its ray. {lacks}.")
        return text.format(lacks=f"{lacks[0].upper()}{lacks[1:]}")
    if state.snapshot.scene is None:
        return tr("No scene yet. Once there is one, click a pixel to see where along its ray the colour comes from.")
    return tr("Click a pixel: here you will see where along its ray the light comes from, sample by sample.")


def _opening(pixel: tuple[int, int]) -> str:
    x, y = (figure(place, ",") for place in pixel)
    return tr("Opening the ray through pixel {x}, {y} …").format(x=x, y=y)


def _point_t(state: AppState, ray: RayProbe) -> float:
    """The distance of the radiance point: as requested, or else as answered, or else the default."""
    if state.inspect is not None and state.inspect.point_t is not None:
        return state.inspect.point_t
    if state.snapshot.radiance is not None:
        return state.snapshot.radiance.t
    return ray.point_t()


def _key(ui: Ui, shape: str, color: int, fill: int) -> None:
    """A sign of the legend, in the shape that the plot uses."""
    at, high, em = imgui.get_cursor_screen_pos(), imgui.get_text_line_height(), ui.em
    draw, low, right = imgui.get_window_draw_list(), ImVec2(at.x, at.y + 0.25 * high), at.x + 0.9 * em
    corner, middle = ImVec2(right, at.y + 0.8 * high), at.y + 0.55 * high
    if shape == "filled":
        draw.add_rect_filled(low, corner, fill)
    if shape in ("box", "filled"):
        draw.add_rect(low, corner, color, thickness=0.1 * em)
    elif shape == "line":
        draw.add_line(ImVec2(at.x, middle), ImVec2(right, middle), color, 0.14 * em)
    else:
        x = at.x + 0.45 * em
        draw.add_line(ImVec2(x, at.y), ImVec2(x, at.y + high), color, 0.1 * em)
    imgui.dummy(ImVec2(0.9 * em, high))


def _glyph(ui: Ui, glyph: Glyph) -> None:
    at, high = imgui.get_cursor_screen_pos(), imgui.get_text_line_height()
    centre = ImVec2(at.x + 0.5 * high, at.y + 0.5 * high)
    glyph(imgui.get_window_draw_list(), centre, 0.3 * ui.em, packed(ui.theme.text))
    imgui.dummy(ImVec2(high, high))
