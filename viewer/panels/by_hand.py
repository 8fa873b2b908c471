"""The bench "Ray by hand": samples that are dragged, with every term of the pixel's equation in numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, localized, marked, tr
from nerf_core.common.text import number, triple
from nerf_core.probe import HandTerms, RayProbe, hand_terms, resample_by_weights, sampled_at, spread_evenly

from ..draw.equations import Piece, Word, equation
from ..draw.hand_plots import HandPlots
from ..model.hand_bench import MOST, PRESETS, HandBench
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, hint, mono, rounded, same_line_if_fits, shown, swatch

BESIDE_EM = 33.0  # width of the panel from which the numbers are beside the plots
APART_EM, APART_NUMBERS_EM, TABLE_EM = 74.0, 24.0, 22.0  # from which the table is apart; the widths of both then
NUMBERS_SHARE, NUMBERS_EM = 0.44, (16.0, 28.0)  # of the width, for the numbers, and its limits
WIDE_TABLE_EM = 21.0  # width of the numbers from which the table has t, σ and δ too
TRIPLE_EM = 20.0  # from which the pixels of other samples have their three numbers
LOW_EM = 19.0  # height of the plots if the numbers are below them
LEAST_PLOTS_EM, ROW_EM = 10.2, 1.1  # and at least, with each row of ticks; a lower panel scrolls
SHOWN_WEIGHT = 0.005  # a lesser weight would stand as 0.00 in the sum, and is left out there
DRAWN, MOST_DRAWN = 16, 64  # samples by the weights, at first and at most
WHY_BOTH = marked(
    "A sample stands for all up to the next: alone, the drawn ones blur every edge. "
    "The fine pass keeps the first samples too. That is exact here: the field is constant between your samples."
)
PICKER = (
    imgui.ColorEditFlags_.no_inputs | imgui.ColorEditFlags_.no_label | imgui.ColorEditFlags_.no_alpha
    | imgui.ColorEditFlags_.no_options
)  # fmt: skip


@PANELS.register("by_hand")
class ByHandPanel:
    title = marked("Ray by hand")
    dock: Literal["bottom"] = "bottom"
    order = 6

    def __init__(self) -> None:
        self.bench, self._plots = HandBench(), HandPlots()
        self._plots.fit(self.bench.ray)
        self._count, self._resampled = DRAWN, False

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        bench, before = self.bench, self.bench.changes
        if not imgui.is_any_item_active() and not imgui.is_mouse_down(imgui.MouseButton_.left):
            bench.end_gesture()
        self._tools(ui, state)
        room = imgui.get_content_region_avail()
        beside = room.x > BESIDE_EM * ui.em
        least, most = (v * ui.em for v in NUMBERS_EM)
        numbers = min(max(NUMBERS_SHARE * room.x, least), most)
        rows = self._rows()
        high = max(room.y, (LEAST_PLOTS_EM + ROW_EM * len(rows)) * ui.em) if beside else LOW_EM * ui.em
        still = imgui.WindowFlags_.no_scroll_with_mouse | imgui.WindowFlags_.no_scrollbar
        apart = room.x > APART_EM * ui.em
        if apart:
            numbers = APART_NUMBERS_EM * ui.em
        taken = (numbers + ui.em if beside else 0.0) + ((TABLE_EM + 1.0) * ui.em if apart else 0.0)
        if imgui.begin_child("plots", ImVec2(room.x - taken, high), window_flags=still):
            self._plots.draw(ui, bench, rows, imgui.get_content_region_avail())
        imgui.end_child()
        if beside:
            imgui.same_line(0, ui.em)
            if imgui.begin_child("numbers", ImVec2(numbers, high)):
                self._numbers(ui, table=not apart)
            imgui.end_child()
        else:
            self._numbers(ui, table=True)
        if apart:
            imgui.same_line(0, ui.em)
            if imgui.begin_child("terms", ImVec2(0, high)):
                self._table(ui, bench.terms)
            imgui.end_child()
        state.hand_changes += bench.changes - before
        yield from ()

    # ---- tools ------------------------------------------------------------------------------------------------------

    def _tools(self, ui: Ui, state: AppState) -> None:
        bench = self.bench
        for preset in PRESETS:
            label = tr(preset.label)
            if preset is not PRESETS[0]:
                same_line_if_fits(label)
            if button(ui, label, f"hand.{preset.mark}", tip=tr(preset.says)):
                bench.load(preset)
                self._plots.fit(bench.ray)
        label, ray = tr("Take this ray"), state.snapshot.ray
        same_line_if_fits(label)
        if button(ui, label, "hand.take", enabled=_can_take(ray), tip=_take_tip(ray)):
            assert ray is not None
            bench.take(ray, state.snapshot.scene.radius if state.snapshot.scene is not None else 1.0)
            self._plots.fit(bench.ray)
        full = len(bench.ray.t) >= MOST
        tip = tr("a ray by hand has ten samples at most") if full else tr("add a sample; or double click in the plot")
        same_line_if_fits(icons.ICON_FA_PLUS)
        if button(ui, icons.ICON_FA_PLUS, "hand.add", enabled=not full, tip=tip):
            bench.add_in_widest()
        same_line_if_fits(icons.ICON_FA_TRASH)
        some = bench.chosen >= 0
        if button(ui, icons.ICON_FA_TRASH, "hand.delete", enabled=some, tip=tr("delete the chosen sample")):
            bench.delete(bench.chosen)
        same_line_if_fits(icons.ICON_FA_ROTATE_LEFT)
        if button(ui, icons.ICON_FA_ROTATE_LEFT, "hand.undo", enabled=bench.can_undo, tip=tr("undo the last change")):
            bench.undo()
            self._plots.fit(bench.ray)
        label = tr("Resample by weights")
        same_line_if_fits(label)
        self._resample_button(ui, label)

    def _resample_button(self, ui: Ui, label: str) -> None:
        """A button that stays pressed."""
        on = self._resampled
        if on:
            imgui.push_style_color(imgui.Col_.button, imgui.get_style().color_(imgui.Col_.frame_bg_active))
        tip = tr("place samples where the weight is, as the fine pass of NeRF does")
        if button(ui, label, "hand.resample", tip=tip):
            self._resampled = not on
        if on:
            imgui.pop_style_color()

    def _rows(self) -> tuple[tuple[str, np.ndarray], ...]:
        """The samples shown as ticks: as many evenly spaced ones as both passes have, and those by the weights."""
        ray = self.bench.ray
        if not self._resampled or not len(ray.t):
            return ()
        return (
            (tr("even"), spread_evenly(ray, len(ray.t) + self._count)),
            (tr("by w"), resample_by_weights(ray, self._count)),
        )

    # ---- numbers ----------------------------------------------------------------------------------------------------

    def _numbers(self, ui: Ui, table: bool) -> None:
        terms, note = self.bench.terms, self.bench.note
        with _close(ui):
            self._sum(ui, terms)
        if note.text:
            hint(ui, tr(note.text).format(**{name: localized(value) for name, value in note.values.items()}))
            ui.mark("hand.note")
        if self._resampled and len(terms.delta):
            imgui.separator()
            self._resampling(ui, terms)
        if self.bench.chosen >= 0:
            imgui.separator()
            self._sample(ui, self.bench.chosen)
            with _close(ui):
                _terms_of(ui, self.bench, self.bench.terms, self.bench.chosen)
        if table:
            imgui.separator()
            self._table(ui, self.bench.terms)

    def _sum(self, ui: Ui, terms: HandTerms) -> None:
        """The equation, and the pixel as the sum of its terms: every weight with its colour."""
        ray, theme = self.bench.ray, ui.theme
        equation(
            ui,
            [
                "Ĉ", "=", "Σ", [("T_i", theme.transmittance), " ", ("α_i", theme.alpha), " c_i"], "+",
                ["(1 − Σ ", ("w_i", theme.fine), ")"], "c_bg",
            ],
        )  # fmt: skip
        words: list[Word] = ["="]
        shown = [i for i in range(len(ray.t)) if terms.weights[i] >= SHOWN_WEIGHT]
        for i in shown:
            words += [[*(["+ "] if i != shown[0] else []), (figure(terms.weights[i], ".2f"), theme.fine), ray.rgb[i]]]
        if len(shown) < len(ray.t):
            words += ["+ …"] if shown else ["…"]
        words += [["+ ", figure(terms.left, ".2f"), ray.background]]
        equation(ui, words, hang=0.9)
        equation(ui, ["=", [terms.pixel, " ", localized(triple(terms.pixel))]])
        ui.mark("hand.pixel")

    def _sample(self, ui: Ui, i: int) -> None:
        """The chosen sample's colour, t and σ, to be changed."""
        bench, em = self.bench, ui.em
        t, sigma, rgb = float(bench.ray.t[i]), float(bench.ray.sigma[i]), bench.ray.rgb[i]
        imgui.align_text_to_frame_padding()
        imgui.text_unformatted(tr("Sample {i}").format(i=i + 1))
        imgui.same_line()
        changed, color = imgui.color_edit3("##colour", rgb.tolist(), PICKER)
        ui.mark("hand.colour")
        imgui.set_item_tooltip(tr("the colour of the chosen sample"))
        if changed:
            bench.paint(i, np.array(color), "colour")
        imgui.same_line(0, 0.7 * em)
        names = sum(imgui.calc_text_size(name).x for name in ("t", "σ")) + 1.3 * em  # with the gaps
        wide = float(np.clip((imgui.get_content_region_avail().x - names) / 2, 3 * em, 5 * em))
        for name, value, speed in (("t", t, 0.005), ("σ", sigma, max(0.01 * sigma, 0.01))):
            if name != "t":
                imgui.same_line(0, 0.7 * em)
            imgui.text_colored(ui.theme.muted if name == "t" else ui.theme.density, name)
            imgui.same_line(0, 0.3 * em)
            imgui.set_next_item_width(wide)
            with mono(ui):
                flags = imgui.SliderFlags_.always_clamp
                changed, wanted = imgui.drag_float(f"##{name}", value, speed, 0.0, 1e6, shown(value, ".3f"), flags)
            ui.mark(f"hand.{name}")
            if changed:
                wanted = rounded(wanted, ".3f")
                moved = (wanted, sigma) if name == "t" else (t, wanted)
                bench.move(i, *moved, gesture=name)
                break  # it may have passed others

    def _resampling(self, ui: Ui, terms: HandTerms) -> None:
        """How many samples are placed by the weights, and what pixel they make; evenly spaced ones to compare."""
        ray = self.bench.ray
        imgui.set_next_item_width(max(imgui.get_content_region_avail().x - 8 * ui.em, 4 * ui.em))
        label = tr("samples")
        _, self._count = imgui.slider_int(f"{label}##count", self._count, 2, MOST_DRAWN)
        ui.mark("hand.count")
        (_, even), (_, drawn) = self._rows()
        both = np.unique(np.concatenate([ray.t, drawn]))
        count = str(self._count)
        rows = (
            (tr("{n} evenly").format(n=str(len(even))), even, True),
            (tr("{n} by w alone").format(n=count), drawn, True),
            (tr("{n} + {m}, fine pass").format(n=str(len(ray.t)), m=count), both, False),  # it is always exact
        )
        numbered = imgui.get_content_region_avail().x > TRIPLE_EM * ui.em
        if imgui.begin_table("resampled", 4 if numbered else 3, imgui.TableFlags_.sizing_fixed_fit):
            for name, t, errs in rows:
                pixel = hand_terms(sampled_at(ray, t)).pixel
                imgui.table_next_column()
                imgui.text_colored(ui.theme.muted, name)
                imgui.table_next_column()
                swatch(ui, pixel)
                with mono(ui):
                    if numbered:
                        _cell(triple(pixel))
                    imgui.table_next_column()
                    error = f"±{figure(np.abs(pixel - terms.pixel).max(), '.3f')}" if errs else ""
                    imgui.text_colored(ui.theme.muted, error)
            imgui.end_table()
        hint(ui, tr(WHY_BOTH))
        ui.mark("hand.resampled")

    def _table(self, ui: Ui, terms: HandTerms) -> None:
        """A line for each sample; a click chooses it. The background has the last one."""
        ray, theme = self.bench.ray, ui.theme
        wide = imgui.get_content_region_avail().x > WIDE_TABLE_EM * ui.em
        columns = [("", theme.muted, 0.7)]
        if wide:
            columns += [("t", theme.muted, 1.0), ("σ", theme.density, 1.25), ("δ", theme.muted, 1.25)]
        columns += [("α", theme.alpha, 1.0), ("T", theme.transmittance, 1.0), ("w", theme.fine, 1.0)]
        columns += [("c", theme.muted, 0.6), ("Σ", theme.muted, 0.6)]
        if not imgui.begin_table("terms", len(columns), imgui.TableFlags_.sizing_stretch_prop):
            return
        for name, _, share in columns:
            imgui.table_setup_column(name, imgui.TableColumnFlags_.width_stretch, share)
        for name, color, _ in columns:
            imgui.table_next_column()
            imgui.text_colored(color, name)
        with mono(ui):
            for i in range(len(ray.t)):
                imgui.table_next_row()
                imgui.table_next_column()
                if imgui.selectable(f"{i + 1}##row", i == self.bench.chosen, imgui.SelectableFlags_.span_all_columns)[
                    0
                ]:
                    self.bench.choose(i)
                ui.mark(f"hand.row {i + 1}")
                if wide:
                    for value in (ray.t[i], ray.sigma[i], terms.delta[i]):
                        _cell(number(float(value), 3))
                for value in (terms.alpha[i], terms.transmittance[i], terms.weights[i]):
                    _cell(figure(value, ".3f"))
                for rgb in (ray.rgb[i], terms.sums[i]):
                    imgui.table_next_column()
                    swatch(ui, rgb)
            self._background_row(ui, terms, empty=len(columns) - 4)
        imgui.end_table()

    def _background_row(self, ui: Ui, terms: HandTerms, empty: int) -> None:
        """The table's last row: the background's colour, its part of the pixel, and the pixel. empty: cells before."""
        background = self.bench.ray.background
        imgui.table_next_row()
        imgui.table_next_column()
        imgui.text_colored(ui.theme.muted, "bg")
        for _ in range(empty):
            imgui.table_next_column()
        _cell(figure(terms.left, ".3f"))
        imgui.table_next_column()
        imgui.push_style_var(imgui.StyleVar_.frame_padding, ImVec2(0, 0))  # as high as the squares above it
        changed, color = imgui.color_edit3("##background", background.tolist(), PICKER)
        imgui.pop_style_var()
        ui.mark("hand.background")
        imgui.set_item_tooltip(tr("the background: what lies behind the ray's end"))
        if changed:
            self.bench.paint(-1, np.array(color), "background")
        imgui.table_next_column()
        swatch(ui, terms.pixel)


def _cell(text: str) -> None:
    imgui.table_next_column()
    imgui.text_unformatted(localized(text))


@contextmanager
def _close(ui: Ui) -> Iterator[None]:
    """Lines that belong together stand closer."""
    imgui.push_style_var(imgui.StyleVar_.item_spacing, ImVec2(0.5 * ui.em, 0.1 * ui.em))
    yield
    imgui.pop_style_var()


def _terms_of(ui: Ui, bench: HandBench, terms: HandTerms, i: int) -> None:
    """The terms of one sample, each as symbols and then with its numbers."""
    ray, theme, k = bench.ray, ui.theme, i + 1
    last = i == len(ray.t) - 1
    delta, sigma = _three(terms.delta[i]), (_three(ray.sigma[i]), theme.density)
    alpha, light = (
        (figure(terms.alpha[i], ".3f"), theme.alpha),
        (figure(terms.transmittance[i], ".3f"), theme.transmittance),
    )
    weight: Piece = figure(terms.weights[i], ".3f"), theme.fine
    end = "far" if last else f"t_{k + 1}"
    ends = f"{_as_fine(ray.edges[i + 1], terms.delta[i])} − {_as_fine(ray.t[i], terms.delta[i])}"
    equation(ui, [f"δ_{k}", "=", [end, f" − t_{k}"], "=", [ends], "=", delta], hang=1.5)
    a: Piece = f"α_{k}", theme.alpha
    equation(
        ui,
        [
            a, "=", ["1 − exp(−", (f"σ_{k}", theme.density), f" δ_{k})"], "=",
            ["1 − exp(−", sigma, f" · {delta})"], "=", alpha,
        ],
        hang=1.5,
    )  # fmt: skip
    words: list[Word] = [(f"T_{k}", theme.transmittance), "="]
    if i:
        words += [["Π_j", " (1 − ", ("α_j", theme.alpha), ")"], "="]
        words += [f"{'· ' if j else ''}{figure(1 - terms.alpha[j], '.3f')}" for j in range(i)]
        words += ["="]
    equation(ui, [*words, light], hang=1.5)
    equation(
        ui,
        [
            (f"w_{k}", theme.fine), "=", [(f"T_{k}", theme.transmittance), " ", a], "=", [light, " · ", alpha], "=",
            weight,
        ],
        hang=1.5,
    )  # fmt: skip
    ui.mark("hand.terms")


def _three(value: float) -> str:
    return localized(number(float(value), 3))


def _as_fine(t: float, delta: float) -> str:
    """A distance with as many decimals as three digits of δ have, so that the difference comes out."""
    decimals = 2 - int(np.floor(np.log10(max(delta, 1e-4))))
    text = f"{t:.{max(decimals, 0)}f}"
    return localized(text.rstrip("0").rstrip(".") if "." in text else text)


def _can_take(ray: RayProbe | None) -> bool:
    return ray is not None and len(ray.last.t) > 0 and bool(np.isfinite(ray.last.weights).all())


def _take_tip(ray: RayProbe | None) -> str:
    if _can_take(ray):
        return tr("copy the opened ray: its samples, merged into ten")
    if ray is None:
        return tr("open a ray first: click a pixel")
    return tr("the opened ray has no samples")
