"""Discs with numbers: the places that a method without samples looked at, in a plot or over the picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from imgui_bundle import ImVec2, ImVec4, imgui

from ..ui.widgets import packed

NUMBERED = 24  # visits: more than these are dots without numbers
DISC_EM, DOT_EM, TEXT_EM = 0.55, 0.28, 0.75  # radii, and the size of the numbers


class Ink(NamedTuple):
    """The colours of discs. edge: around them, and of their numbers. rim: around the one that is pointed at."""

    fill: ImVec4
    edge: ImVec4
    rim: ImVec4


def discs(
    draw: imgui.ImDrawList,
    centres: Sequence[ImVec2 | None],
    em: float,
    ink: Ink,
    marked: int | None = None,
    numbered: bool = True,
) -> None:
    """Draw a disc at the screen position of each visit, the later over the earlier; None: it is not seen.

    marked: the visit that the user points at. numbered: write the numbers, unless there are more than NUMBERED.
    """
    numbered = numbered and len(centres) <= NUMBERED
    r, size = (DISC_EM if numbered else DOT_EM) * em, TEXT_EM * em
    edge, fill, rim = packed(ink.edge), packed(ink.fill), packed(ink.rim)
    for k, at in enumerate(centres):
        if at is None:
            continue
        draw.add_circle_filled(at, r + 0.08 * em, edge)
        draw.add_circle_filled(at, r, fill)
        if k == marked:
            draw.add_circle(at, r + 0.15 * em, rim, thickness=0.12 * em)
        if numbered:
            text = f"{k + 1}"
            wide = imgui.calc_text_size(text).x * size / imgui.get_font_size()
            draw.add_text(imgui.get_font(), size, ImVec2(at.x - wide / 2, at.y - size / 2), edge, text)
