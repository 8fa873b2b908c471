"""Equations as lines of words that wrap, with subscripts, coloured symbols, and colours as squares."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from ..ui.widgets import color_of, mono, packed

if TYPE_CHECKING:
    from ..ui.contract import Ui

Piece = str | tuple[str, ImVec4]  # a text, in the text's colour or in one of its own
Word = Piece | list[Piece | np.ndarray] | np.ndarray  # a list holds together; an array (3,) is a square of that colour
SMALL, LOWER = 0.8, 0.3  # of em: the size of a subscript, and how far below the line it stands
GAP = 0.4  # em between words
SUBSCRIPT = re.compile(r"_(\w+)")


def equation(ui: Ui, words: Sequence[Word], hang: float = 0.0) -> None:
    """Draw an equation in the font of figures. It wraps between words.

    Args:
        ui: where to draw.
        words: "_" begins a subscript, as in "σ_3".
        hang: how far the lines after the first are indented, in em.
    """
    with mono(ui):
        at, room = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x
        high = imgui.get_text_line_height() + 0.15 * ui.em
        x, y, widest = 0.0, 0.0, 0.0
        for word in words:
            pieces = word if isinstance(word, list) else [word]
            wide = sum(_width(ui, piece) for piece in pieces)
            if x > hang * ui.em and x + wide > room:
                x, y = hang * ui.em, y + high
            for piece in pieces:
                _draw(ui, piece, ImVec2(at.x + x, at.y + y))
                x += _width(ui, piece)
            widest = max(widest, x)
            x += GAP * ui.em
        imgui.dummy(ImVec2(max(widest, 1.0), y + high))


@lru_cache(1024)
def _parts(text: str) -> list[tuple[str, bool]]:
    """The parts of a text, in turns on the line and in a subscript."""
    return [(part, bool(k % 2)) for k, part in enumerate(SUBSCRIPT.split(text)) if part]


def _width(ui: Ui, piece: Piece | np.ndarray) -> float:
    if isinstance(piece, np.ndarray):
        return 0.9 * ui.em
    text = piece if isinstance(piece, str) else piece[0]
    return sum(imgui.calc_text_size(part).x * (SMALL if low else 1.0) for part, low in _parts(text))


def _draw(ui: Ui, piece: Piece | np.ndarray, at: ImVec2) -> None:
    draw = imgui.get_window_draw_list()
    if isinstance(piece, np.ndarray):
        side, top = 0.8 * ui.em, at.y + 0.12 * ui.em
        low, high = ImVec2(at.x + 0.1 * ui.em, top), ImVec2(at.x + 0.1 * ui.em + side, top + side)
        draw.add_rect_filled(low, high, packed(color_of(piece)))
        draw.add_rect(low, high, packed(ui.theme.hairline))
        return
    text, color = piece if isinstance(piece, tuple) else (piece, ui.theme.text)
    x = at.x
    for part, low in _parts(text):
        share = SMALL if low else 1.0
        place = ImVec2(x, at.y + (LOWER * ui.em if low else 0.0))
        draw.add_text(ui.mono, share * ui.em, place, packed(color), part)
        x += share * imgui.calc_text_size(part).x
