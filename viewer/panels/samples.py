"""The samples panel: the samples of the opened ray in numbers, one line each."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import figure, marked, tr
from nerf_core.common.text import number, triple
from nerf_core.probe import PassProbe

from ..model.state import Action, AppState, SampleRef
from ..ui.contract import PANELS, Ui
from ..ui.theme import CLEAR
from ..ui.widgets import faded, mono, nothing_yet, packed, swatch

COLUMNS = ("", "t", "δ", "σ", "α", "T", "w", marked("colour"))
WIDTHS_EM = (3.0, 5.0, 5.0, 5.0, 4.5, 4.5, 4.5, 11.0)


@PANELS.register("samples")
class SamplesPanel:
    title = marked("Samples")
    dock: Literal["bottom"] = "bottom"
    order = 3

    def __init__(self) -> None:
        self.one = -1  # the pass; −1: the last
        self._pointed: SampleRef | None = None

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        yield from ()
        ray = state.snapshot.ray
        if ray is None or not ray.passes:
            text = tr("Click a pixel: here you will see the samples of its ray in numbers.")
            nothing_yet(ui, state.snapshot.method, text)
            return
        count = len(ray.passes)
        self.one = self.one if 0 <= self.one < count else count - 1
        for k, one in enumerate(ray.passes if count > 1 else ()):
            if imgui.radio_button(f"{tr(one.name)}, {figure(len(one.t), ',')}###pass {k}", self.one == k):
                self.one = k
            ui.mark(f"samples.pass {k}")
            imgui.same_line()
        if count > 1:
            imgui.new_line()
        self._table(ui, state, ray.passes[self.one])

    def _table(self, ui: Ui, state: AppState, one: PassProbe) -> None:
        flags = imgui.TableFlags_.scroll_x | imgui.TableFlags_.scroll_y | imgui.TableFlags_.sizing_fixed_fit
        if not imgui.begin_table("samples", len(COLUMNS), flags, imgui.get_content_region_avail()):
            return
        imgui.table_setup_scroll_freeze(0, 1)
        for name, width in zip(COLUMNS, WIDTHS_EM, strict=True):
            imgui.table_setup_column(tr(name), imgui.TableColumnFlags_.width_fixed, width * ui.em)
        imgui.table_headers_row()
        style = imgui.get_style()  # a selectable fills exactly its own line
        imgui.push_style_var(imgui.StyleVar_.item_spacing, ImVec2(style.item_spacing.x, 2 * style.cell_padding.y))
        for color in (imgui.Col_.header, imgui.Col_.header_hovered, imgui.Col_.header_active):
            imgui.push_style_color(
                color, CLEAR
            )  # the line under the mouse is marked below, like a sample marked in another panel
        clipper = imgui.ListClipper()  # a ray may have a thousand samples
        clipper.begin(len(one.t))
        while clipper.step():
            for i in range(clipper.display_start, clipper.display_end):
                self._row(ui, state, one, i)
        imgui.pop_style_color(3)
        imgui.pop_style_var()
        self._show_pointed_at(state, clipper.items_height)
        imgui.end_table()

    def _show_pointed_at(self, state: AppState, row: float) -> None:
        """Scroll to the line of the sample that the user points at in another panel."""
        before, self._pointed = self._pointed, state.sample
        if state.sample in (None, before) or state.sample.one != self.one or imgui.is_window_hovered():
            return
        imgui.set_scroll_y(max(row * (state.sample.at + 1.5) - 0.5 * imgui.get_window_height(), 0.0))

    def _row(self, ui: Ui, state: AppState, one: PassProbe, i: int) -> None:
        imgui.table_next_row()
        imgui.table_next_column()
        ref = SampleRef(self.one, i)
        if state.sample == ref:
            imgui.table_set_bg_color(imgui.TableBgTarget_.row_bg0, packed(faded(ui.theme.accent, 0.25)))
        spans = imgui.SelectableFlags_.span_all_columns
        with mono(ui):
            imgui.selectable(f"{i + 1}", False, spans, ImVec2(0, 0))
            ui.mark(f"samples.row {i}")
            if imgui.is_item_hovered():
                state.pointed_at = ref
            for values, digits in ((one.t, 5), (one.delta, 3), (one.sigma, 4)):
                imgui.table_next_column()
                imgui.text_unformatted(tr(number(float(values[i]), digits)))
            for values in (one.alpha, one.transmittance, one.weights):
                imgui.table_next_column()
                imgui.text_unformatted(figure(float(values[i]), ".4f"))
            imgui.table_next_column()
            partial(swatch, ui, one.rgb[i])()
            imgui.same_line(0, 0.2 * ui.em)
            imgui.text_unformatted(tr(triple(one.rgb[i])))
