"""Paragraphs with *emphasis*, **strong** and `code`, wrapped at the window's edge."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from imgui_bundle import ImVec2, ImVec4, imgui

from ..ui.widgets import faded, packed

if TYPE_CHECKING:
    from ..ui.contract import Ui

MARKS = re.compile(r"(\*\*[^*]+\*\*|\*[^*\s][^*]*\*|`[^`]+`)")
BOLD_EM, BOLD_ALPHA = 1 / 30, 0.6  # strong letters are drawn again, so far to the right: the font has one weight
MARGIN_EM = 0.4  # at the right, towards a scroll bar
LEADING = 1.25  # height of a line, of the text's


class Word(NamedTuple):
    """A word without spaces. glued: whether it follows the word before it without a space."""

    text: str
    style: str  # "", "strong", "emphasis" or "code"
    glued: bool


@lru_cache(maxsize=512)
def words(text: str) -> tuple[Word, ...]:
    """Return the words of a paragraph with their styles."""
    return tuple(_words(text))


def _words(text: str) -> Iterator[Word]:
    after_space = True
    for part in MARKS.split(text):
        style, inner = "", part
        if len(part) > 4 and part.startswith("**") and part.endswith("**"):
            style, inner = "strong", part[2:-2]
        elif len(part) > 2 and part[0] == part[-1] == "*":
            style, inner = "emphasis", part[1:-1]
        elif len(part) > 2 and part[0] == part[-1] == "`":
            style, inner = "code", part[1:-1]
        for k, word in enumerate(inner.split()):
            yield Word(word, style, k == 0 and not after_space and not inner[:1].isspace())
        if inner:
            after_space = inner[-1].isspace()


def rich_text(ui: Ui, text: str, color: ImVec4 | None = None, indent: float = 0.0) -> None:
    """Draw a paragraph.

    Args:
        ui: where to draw.
        text: the paragraph.
        color: of its plain words; None: the text's.
        indent: of all lines, in pixels.
    """
    theme, draw = ui.theme, imgui.get_window_draw_list()
    at, wide = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x - MARGIN_EM * ui.em
    line, space = round(LEADING * imgui.get_text_line_height()), imgui.calc_text_size(" ").x
    x, y = indent, 0.0
    for word in words(text):
        code = word.style == "code"
        if code:
            imgui.push_font(ui.mono, ui.em)
        size = imgui.calc_text_size(word.text).x
        gap = 0.0 if word.glued or x == indent else space
        if x + gap + size > wide and x > indent:
            x, y, gap = indent, y + line, 0.0
        place = ImVec2(int(at.x + x + gap), int(at.y + y))
        shown = {"emphasis": theme.accent, "code": theme.good}.get(word.style, color or theme.text)
        draw.add_text(place, packed(shown), word.text)
        if word.style == "strong":
            again = ImVec2(place.x + max(1, round(BOLD_EM * ui.em)), place.y)
            draw.add_text(again, packed(faded(shown, BOLD_ALPHA)), word.text)
        if code:
            imgui.pop_font()
        x += gap + size
    imgui.dummy(ImVec2(wide, y + line))
