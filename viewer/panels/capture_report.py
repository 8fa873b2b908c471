"""The capture report: what the photos' places, sharpness and exposure say before and while a model is trained."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.captures.report_records import CaptureReport, PhotoFacts, ReportState
from nerf_core.common.language import figure, marked, tr
from nerf_core.common.text import NOTHING
from nerf_core.live.messages import CancelReport, StartReport, WriteReport

from ..model.state import Action, AppState, GoToView
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, field_beside, hint, mono, same_line_if_fits

CHECK, AGAIN, CANCEL = marked("Check the photos"), marked("Check again"), marked("Cancel")
WRITE = marked("Write the page")
BESIDE_EM, WORDS_EM = 42.0, 21.0  # width of the panel from which the table is beside the sentences, and theirs then
NAME_EM = 9.0  # width of names
SHOWN = marked("Click a photo to look through it.")


def _unknown_last(value: float) -> float:
    return value if math.isfinite(value) else math.inf


# name, tip, what it sorts by
COLUMNS: tuple[tuple[str, str, Callable[[PhotoFacts], float | str]], ...] = (
    (marked("photo"), "", lambda p: p.name),
    (
        marked("sharpness"),
        marked("ratio of fine to coarse detail, over the median of similar views: below 0.7 a photo is soft"),
        lambda p: _unknown_last(p.relative_sharpness),
    ),
    (
        marked("exposure"),
        marked("mean brightness in stops, less the median of similar views"),
        lambda p: _unknown_last(p.relative_exposure),
    ),
    (marked("clipped"), marked("share of pixels that are overexposed"), lambda p: p.highlights),
    (
        marked("nearest view"),
        marked("how far the most similar training photo is, in degrees"),
        lambda p: _unknown_last(p.separation),
    ),
    (marked("remark"), "", lambda p: -len(p.odd)),
)


@PANELS.register("capture_report")
class CaptureReportPanel:
    title = marked("Capture report")
    dock: Literal["bottom"] = "bottom"
    order = 8

    def __init__(self) -> None:
        self._file = ""
        self._of: tuple[CaptureReport, int, bool] | None = None  # what `_rows` is the order of
        self._rows: list[int] = []

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot = state.snapshot
        newest = snapshot.report
        if newest is not None and newest.loaded != snapshot.loaded:
            newest = None  # it was about another scene
        if snapshot.scene is None:
            hint(ui, tr("Open a scene: here its photos are checked for gaps, blur, exposure and calibration."))
            return
        yield from self._buttons(ui, state, newest)
        if newest is None:
            hint(ui, tr("What limits the quality, and what to photograph next: places, blur, exposure, calibration."))
        elif newest.state == "cancelled":
            hint(ui, tr("Cancelled."))
        elif newest.state == "failed":
            hint(ui, tr("The check failed: see Notices."), ui.theme.error)
        report = newest.report if newest is not None else None
        if report is None:
            return
        room = imgui.get_content_region_avail()
        beside = room.x > BESIDE_EM * ui.em
        imgui.begin_child("words", ImVec2(WORDS_EM * ui.em if beside else 0.0, 0.0 if beside else room.y * 0.5))
        _words(ui, report)
        imgui.end_child()
        if beside:
            imgui.same_line(0, ui.em)
        imgui.begin_child("table", ImVec2(0, 0))
        yield from self._table(ui, state, report)
        imgui.end_child()

    def _buttons(self, ui: Ui, state: AppState, newest: ReportState | None) -> Iterator[Action]:
        if newest is not None and newest.state == "running":
            cancel = f"{icons.ICON_FA_XMARK}  {tr(CANCEL)}"
            if button(ui, cancel, "report.cancel"):
                yield CancelReport()
            imgui.same_line()
            text = f"{figure(100 * newest.fraction, '.0f')} %   {tr(newest.text)}"
            imgui.progress_bar(newest.fraction, ImVec2(-1, 0), text)
            ui.mark("report.progress")
            return
        done = newest is not None and newest.report is not None
        label = f"{icons.ICON_FA_MAGNIFYING_GLASS}  {tr(AGAIN if done else CHECK)}"
        if button(ui, label, "report.check", tip=tr("training and the window go on meanwhile")):
            yield StartReport()
        if not done:
            return
        write = f"{icons.ICON_FA_FILE_LINES}  {tr(WRITE)}"
        same_line_if_fits(write, 10 * ui.em)
        field_beside(ui, write)
        scene = state.snapshot.scene
        usual = f"{scene.name if scene is not None else ''}-report.html"
        _, self._file = imgui.input_text_with_hint("##report.file", usual, self._file)
        ui.mark("report.file")
        imgui.same_line()
        tip = tr("one HTML page with pictures, and a JSON file with the numbers beside it")
        if button(ui, write, "report.write", tip=tip):
            yield WriteReport(Path(self._file.strip() or usual))

    # ---- photos ---------------------------------------------------------------------------------------------------

    def _table(self, ui: Ui, state: AppState, report: CaptureReport) -> Iterator[Action]:
        flags = imgui.TableFlags_.scroll_y | imgui.TableFlags_.sizing_fixed_fit | imgui.TableFlags_.sortable
        flags |= imgui.TableFlags_.row_bg | imgui.TableFlags_.borders_inner_h | imgui.TableFlags_.scroll_x
        if not imgui.begin_table("photos", len(COLUMNS), flags, imgui.get_content_region_avail()):
            return
        imgui.table_setup_scroll_freeze(1, 1)
        for k, (name, _, _) in enumerate(COLUMNS):
            chosen = imgui.TableColumnFlags_.default_sort if k == len(COLUMNS) - 1 else imgui.TableColumnFlags_.none
            imgui.table_setup_column(f"{tr(name)}###{name}", chosen, NAME_EM * ui.em if not k else 0.0)
        self._headers(ui)
        self._sort(report)
        clipper = imgui.ListClipper()  # thousands of rows cost as much as those that are seen
        clipper.begin(len(self._rows))
        while clipper.step():
            for place in range(clipper.display_start, clipper.display_end):
                yield from _row(ui, state, report, self._rows[place])
        imgui.end_table()

    def _headers(self, ui: Ui) -> None:
        imgui.table_next_row(imgui.TableRowFlags_.headers)
        for k, (name, tip, _) in enumerate(COLUMNS):
            imgui.table_set_column_index(k)
            imgui.table_header(f"{tr(name)}###{name}")
            ui.mark(f"report.sort.{name}")
            if tip and imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip):
                imgui.set_tooltip(tr(tip))

    def _sort(self, report: CaptureReport) -> None:
        """Put the rows in the order of the column that the user chose; at first, photos with remarks come first."""
        column, falling = len(COLUMNS) - 1, False
        specs = imgui.table_get_sort_specs()
        if specs is not None and specs.specs_count:
            spec = specs.get_specs(0)
            column, falling = int(spec.column_index), spec.get_sort_direction() == imgui.SortDirection.descending
        if self._of is None or self._of[0] is not report or self._of[1:] != (column, falling):
            by = COLUMNS[column][2]
            self._rows = sorted(range(len(report.photos)), key=lambda k: by(report.photos[k]), reverse=falling)  # pyright: ignore
            self._of = (report, column, falling)


def _words(ui: Ui, report: CaptureReport) -> None:
    imgui.text_wrapped(tr(report.overall))
    imgui.dummy(ImVec2(0, 0.2 * ui.em))
    hint(ui, tr(report.summary))
    _title(ui, tr("What limits the quality"))
    if not report.limits:
        hint(ui, tr("No limit was found."), ui.theme.good)
    for k, limit in enumerate(report.limits, 1):
        imgui.text_colored(ui.theme.warning, f"{k}.")
        imgui.same_line()
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted(_sentence(limit.text))
        imgui.pop_text_wrap_pos()
        hint(ui, f"→ {tr(limit.advice)}")
    _title(ui, tr("What to photograph next"))
    for text in report.next or (marked("Nothing is missing."),):
        imgui.bullet()
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted(_sentence(text))
        imgui.pop_text_wrap_pos()
    _title(ui, tr("Calibration"))
    for text in report.calibration:
        hint(ui, _sentence(text))


def _title(ui: Ui, text: str) -> None:
    imgui.dummy(ImVec2(0, 0.2 * ui.em))
    imgui.text_colored(ui.theme.accent, text)


def _sentence(text: str) -> str:
    text = tr(text)
    return f"{text[:1].upper()}{text[1:]}"


def _row(ui: Ui, state: AppState, report: CaptureReport, k: int) -> Iterator[Action]:
    p = report.photos[k]
    imgui.table_next_row()
    imgui.table_next_column()
    pressed, _ = imgui.selectable(
        f"{f'{icons.ICON_FA_TRIANGLE_EXCLAMATION} ' if p.odd else ''}{p.name}##{k}",
        state.current_view == p.view,
        imgui.SelectableFlags_.span_all_columns,
    )
    ui.mark(f"report.photo.{k}")
    if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip):
        near = report.photos[p.nearest].name if p.nearest >= 0 else NOTHING
        lines = [p.name, *map(_sentence, p.odd), tr("most similar: {name}").format(name=near), tr(SHOWN)]
        imgui.set_tooltip("\n".join(lines))
    color = ui.theme.warning if p.odd else ui.theme.text
    cells = (
        _number(p.relative_sharpness, ".2f"),
        _number(p.relative_exposure, "+.2f"),
        f"{_number(100 * p.highlights, '.0f')} %",
        f"{_number(p.separation, '.1f')}°" if math.isfinite(p.separation) else NOTHING,
    )
    with mono(ui):
        for text in cells:
            imgui.table_next_column()
            imgui.text_colored(color, text)
    imgui.table_next_column()
    imgui.text_colored(color, "; ".join(map(_sentence, p.odd)))
    if pressed:
        yield GoToView(p.view)


def _number(value: float, spec: str) -> str:
    """Return a number with a real minus sign. A zero has no minus."""
    return figure(float(format(value, spec)) or 0.0, spec).replace("-", "−") if math.isfinite(value) else NOTHING
