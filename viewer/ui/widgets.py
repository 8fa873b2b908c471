"""Widgets that several panels share: figures, buttons that tests can find, hints, confirmations."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.colormaps import Name, colored
from nerf_core.common.errors import UserError
from nerf_core.common.language import figure, marked, said, tr
from nerf_core.common.names import printable
from nerf_core.common.text import decimal, number, triple
from nerf_core.common.user_paths import own_path
from nerf_core.methods import lacking

if TYPE_CHECKING:
    from nerf_core.live.messages import Notice
    from nerf_core.probe import PassProbe, RayProbe

    from .contract import Ui

KEEP = marked("Keep")
STALE = marked("An earlier picture, warped, until new pixels are as sharp")  # what the viewport shows
ANSWERS = {
    "open": (marked("Save and open"), marked("Forget and open")),
    "load": (marked("Save and load"), marked("Forget and load")),
    "change": (marked("Save and change"), marked("Forget and change")),
    "start again": (marked("Save and start again"), marked("Forget and start again")),
}  # of `Forgetting`, by what would be done then
SCALE_STEPS = 16  # of a colour scale: about as many as colour maps have stops

# ---- colours -------------------------------------------------------------------------------------------------


def color_of(rgb: Sequence[float] | np.ndarray, alpha: float = 1.0) -> ImVec4:
    """Convert a colour of the model for imgui: clipped to [0, 1]; a channel that is NaN is 0."""
    r, g, b = (min(max(c, 0.0), 1.0) if not isnan(c) else 0.0 for c in map(float, rgb))
    return ImVec4(r, g, b, alpha)


def faded(color: ImVec4, alpha: float) -> ImVec4:
    return ImVec4(color.x, color.y, color.z, color.w * alpha)


def packed(color: ImVec4) -> int:
    """Pack a colour for draw lists."""
    return imgui.color_convert_float4_to_u32(color)


def tints(rgb: np.ndarray, alpha: np.ndarray | float = 1.0) -> list[int]:
    """Pack colours (N, 3) in [0, 1] like imgui; NaN becomes black."""
    rgba = np.column_stack([rgb, np.broadcast_to(alpha, len(rgb))])
    levels = np.round(255 * np.clip(np.nan_to_num(rgba), 0, 1)).astype(np.uint32)
    return (levels << np.array([0, 8, 16, 24], np.uint32)).sum(-1).tolist()


def exists(path: Path) -> bool:
    """Return whether a path exists, as a user types it."""
    try:
        return os.path.exists(own_path(path))
    except UserError:
        return False


# ---- widgets -------------------------------------------------------------------------------------------------


@contextmanager
def mono(ui: Ui) -> Iterator[None]:
    imgui.push_font(ui.mono, ui.em)
    yield
    imgui.pop_font()


def hint(ui: Ui, text: str, color: ImVec4 | None = None) -> None:
    """Draw a quiet line that wraps at the window's edge."""
    imgui.push_style_color(imgui.Col_.text, color or ui.theme.muted)
    imgui.text_wrapped(text)
    imgui.pop_style_color()


def nothing_yet(ui: Ui, method: str, text: str, needs: Sequence[str] = ("trace",)) -> None:
    """Draw the hint of a panel that has nothing to show: what the method lacks for it, otherwise `text`.

    needs: what the panel needs of the method; keys of `nerf_core.methods.ABSENT`.
    """
    missing = next(filter(None, (lacking(method, ability) for ability in needs)), "")
    hint(ui, tr("There is nothing to show here: {missing}.").format(missing=tr(missing)) if missing else text)


def button(ui: Ui, label: str, mark: str, *, enabled: bool = True, tip: str = "", width: float = 0.0) -> bool:
    """Draw a button that tests find as `mark`. Its tooltip also shows while it is disabled."""
    imgui.begin_disabled(not enabled)
    pressed = imgui.button(f"{label}##{mark}", ImVec2(width, 0))
    imgui.end_disabled()
    ui.mark(mark)
    if tip and imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled | imgui.HoveredFlags_.for_tooltip):
        imgui.set_tooltip(tip)
    return pressed


def keep_in_front() -> None:
    """Keep the window just begun above the docked ones, which come to the front when they are clicked."""
    imgui.internal.bring_window_to_display_front(imgui.internal.get_current_window())


def same_line_if_fits(label: str, more: float = 0.0) -> None:
    """Stay on the line if a button called `label`, and `more` pixels, fit beside the last item; else start a line."""
    style = imgui.get_style()
    width = imgui.calc_text_size(label).x + 2 * style.frame_padding.x + more
    right = imgui.get_cursor_screen_pos().x + imgui.get_content_region_avail().x
    if imgui.get_item_rect_max().x + style.item_spacing.x + width <= right:
        imgui.same_line()


def same_line_for(width: float, gap: float) -> None:
    """Stay on the line if an item of this width fits on it after a gap, both in pixels; else start a line."""
    right = imgui.get_cursor_screen_pos().x + imgui.get_content_region_avail().x
    if imgui.get_item_rect_max().x + gap + width <= right:
        imgui.same_line(0, gap)


def swatch(ui: Ui, rgb: Sequence[float] | np.ndarray) -> None:
    """Draw a square of a colour, as high as a line, with a hairline so that it shows on any background."""
    size = imgui.get_text_line_height()
    at = imgui.get_cursor_screen_pos()
    inset = 0.1 * ui.em
    low, high = ImVec2(at.x, at.y + inset), ImVec2(at.x + size - inset, at.y + size - inset)
    draw = imgui.get_window_draw_list()
    draw.add_rect_filled(low, high, packed(color_of(rgb)))
    draw.add_rect(low, high, packed(ui.theme.hairline))
    imgui.dummy(ImVec2(size, size))


def color_scale(draw: imgui.ImDrawList, low: ImVec2, high: ImVec2, name: Name = "viridis") -> None:
    """Draw a colour map from left to right."""
    colors = tints(colored(np.linspace(0, 1, SCALE_STEPS + 1), 0, 1, name))
    edges = np.linspace(low.x, high.x, SCALE_STEPS + 1).tolist()
    for (left, first), (right, last) in pairwise(zip(edges, colors, strict=True)):
        draw.add_rect_filled_multi_color(ImVec2(left, low.y), ImVec2(right, high.y), first, last, last, first)


Row = tuple[str, str] | tuple[str, str, Callable[[], None]]


def figures(ui: Ui, name: str, rows: Sequence[Row], width: float | None = None) -> None:
    """Draw rows of a label and a figure in the mono font. A third entry of a row draws something before the figure.

    Labels are in the window's language; a figure may be a phrase. If two columns do not fit, a figure goes under its
    label. width: None takes the window's remaining width; a tooltip grows with its content and needs a width.
    """
    width = width or imgui.get_content_region_avail().x
    label_width = max(imgui.calc_text_size(row[0]).x for row in rows) + 0.8 * ui.em
    stacked = width < label_width + 6 * ui.em
    if not imgui.begin_table(name, 1 if stacked else 2, imgui.TableFlags_.sizing_fixed_fit, ImVec2(width, 0)):
        return
    if not stacked:
        imgui.table_setup_column("label", imgui.TableColumnFlags_.width_fixed, label_width)
        imgui.table_setup_column("figure", imgui.TableColumnFlags_.width_stretch)
    for row in rows:
        imgui.table_next_column()
        imgui.text_colored(ui.theme.muted, row[0])
        imgui.table_next_column()
        if len(row) == 3:
            row[2]()
            imgui.same_line(0, 0.2 * ui.em)
        imgui.push_text_wrap_pos(0.0)  # numbers that do not fit beside each other wrap
        with mono(ui):
            imgui.text_unformatted(said(row[1]))
        imgui.pop_text_wrap_pos()
    imgui.end_table()


def sample_tooltip(ui: Ui, p: PassProbe, index: int) -> None:
    """Show a sample's numbers in a tooltip."""
    rows: list[Row] = [
        ("t", figure(p.t[index], ".5f")),
        ("σ", number(float(p.sigma[index]), 5)),
        ("α", figure(p.alpha[index], ".5f")),
        ("T", figure(p.transmittance[index], ".5f")),
        ("w", figure(p.weights[index], ".5f")),
        ("rgb", triple(p.rgb[index]), partial(swatch, ui, p.rgb[index])),
    ]
    if imgui.begin_tooltip():
        numbers = {"i": figure(index + 1, ","), "total": figure(len(p.t), ",")}
        imgui.text_colored(ui.theme.muted, tr("{name} sample {i} of {total}").format(name=tr(p.name), **numbers))
        figures(ui, "sample", rows, 15 * ui.em)
        imgui.end_tooltip()


def visit_tooltip(ui: Ui, ray: RayProbe, index: int) -> None:
    """Show in a tooltip a place that a method without samples looked at."""
    t = ray.visited
    rows: list[Row] = [("t", figure(t[index], ".5f"))]
    if index:
        rows.append((tr("moved"), decimal(float(t[index] - t[index - 1]), 5)))
    if imgui.begin_tooltip():
        numbers = {"i": figure(index + 1, ","), "total": figure(len(t), ",")}
        imgui.text_colored(ui.theme.muted, tr("visit {i} of {total}").format(**numbers))
        figures(ui, "visit", rows, 15 * ui.em)
        imgui.end_tooltip()


def field_width(ui: Ui, label: str) -> None:
    """Size the next field so that its label fits on its right; at least 4 em."""
    avail = imgui.get_content_region_avail().x
    label_width = imgui.calc_text_size(label, hide_text_after_double_hash=True).x
    spacing = imgui.get_style().item_inner_spacing.x if label_width else 0.0
    imgui.set_next_item_width(max(avail - label_width - spacing, min(avail, 4 * ui.em)))


def shown(value: float, spec: str, before: str = "", after: str = "") -> str:
    """Return what a slider or a field to drag shows: a number in the window's language, between two texts.

    imgui takes a format, and would write the number with a decimal point. This one has no place for a number, so imgui
    does not round either: see `rounded`. While a number is typed it has a point, and a typed comma counts as one.
    """
    return f"{before}{figure(value, spec)}{after}".replace("%", "%%")


def rounded(value: float, spec: str) -> float:
    """Return a field's new number, which has single precision, as the field shows it by a format specification."""
    return float(format(value, spec))


LEVELS = {
    "info": icons.ICON_FA_CIRCLE_INFO,
    "warning": icons.ICON_FA_TRIANGLE_EXCLAMATION,
    "error": icons.ICON_FA_CIRCLE_XMARK,
}


def notice_text(ui: Ui, notice: Notice) -> None:
    """Draw the level's sign and the text, which wraps. A path at its end is left out, because it has its own line.

    "saved step 5 to run.safetensors" becomes "saved step 5:", with the path below.
    """
    text = tr(notice.text)
    color = {"info": ui.theme.good, "warning": ui.theme.warning, "error": ui.theme.error}[notice.level]
    imgui.text_colored(color, LEVELS[notice.level])
    imgui.same_line()
    imgui.push_text_wrap_pos(0.0)
    before = text.removesuffix(f" {printable(notice.path)}") if notice.path is not None else text
    imgui.text_unformatted(text if before == text else f"{before.removesuffix(' ' + tr('to')).rstrip(':')}:")
    imgui.pop_text_wrap_pos()


def field_beside(ui: Ui, *labels: str) -> None:
    """Size the next field so that buttons with these labels fit beside it; at least 5 em."""
    style, room = imgui.get_style(), imgui.get_content_region_avail().x
    frame = 2 * style.frame_padding.x + style.item_spacing.x
    beside = sum(imgui.calc_text_size(label).x + frame for label in labels)
    imgui.set_next_item_width(max(room - beside - 1, min(room, 5 * ui.em)))  # one pixel less, for rounding


def path_line(ui: Ui, path: Path, mark: str) -> None:
    """Draw a path that wraps, and a button that copies it."""
    shown = printable(path)  # as the fields for paths take it; a clipboard holds no other text
    if button(ui, icons.ICON_FA_COPY, mark, tip=tr("copy the path: {path}").format(path=shown)):
        imgui.set_clipboard_text(shown)
    imgui.same_line()
    imgui.text_wrapped(shown)


class Confirmation:
    """A question in the panel, without a dialog, before something that cannot be undone."""

    def __init__(self) -> None:
        self.asking = self._shown = False

    def draw(self, ui: Ui, question: str, answer: str, mark: str, needed: bool) -> bool:
        """Show the question while it is open and `needed`. Returns True in the frame in which the user agrees."""
        return self._ask(ui, question, {"confirm": (answer, "")}, mark, needed) == "confirm"

    def _ask(self, ui: Ui, question: str, answers: dict[str, tuple[str, str]], mark: str, needed: bool) -> str:
        """Show the question with its answers, by the ends of their marks with label and tip, and "Keep".

        Returns the end of the mark of the answer that was chosen, else an empty text.
        """
        self.asking = self.asking and needed and not imgui.is_key_pressed(imgui.Key.escape, False)
        if not self.asking:
            self._shown = False
            return ""
        hint(ui, question, ui.theme.warning)
        found, labels = "", [label for label, _ in answers.values()]
        for (end, (label, tip)), after in zip(answers.items(), [*labels[1:], tr(KEEP)], strict=True):
            if button(ui, label, f"{mark}_{end}", tip=tip):
                found = end
            same_line_if_fits(after)
        if button(ui, tr(KEEP), f"{mark}_keep", tip=tr("change nothing")) or found:
            self.asking = False
        if not self._shown:  # it may lie below the visible part of the panel
            imgui.set_scroll_here_y(1.0)
            self._shown = True
        return found


class Forgetting(Confirmation):
    """A question before a model is forgotten, which offers to save it first."""

    def ask(self, ui: Ui, question: str, verb: str, mark: str, needed: bool) -> Literal["", "forget", "save"]:
        """Show the question while it is open and `needed`. Returns the answer in the frame in which the user agrees.

        Args:
            ui: where to draw.
            question: what would be forgotten.
            verb: what would be done then; a key of ANSWERS.
            mark: the widgets' name.
            needed: whether there is anything to forget.
        """
        save, forget = ANSWERS[verb]
        answers = {"save": (tr(save), tr("save to a new file first")), "confirm": (tr(forget), "")}
        found = self._ask(ui, question, answers, mark, needed)
        return "save" if found == "save" else "forget" if found else ""
