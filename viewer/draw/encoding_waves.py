"""The positional encoding of a pixel's coordinates: its waves over the picture, and its numbers as a bar code."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.common.colormaps import colored
from nerf_core.common.language import figure, tr

from ..ui.contract import Ui
from ..ui.widgets import color_scale, hint, packed, tints

SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
LABEL_EM, CELL_EM, GAP_EM = 2.4, 1.5, 0.4
ROW_EM = 0.3, 1.0  # least and largest height of a wave's row


def place(pixel: int, longest: int) -> float:
    """Return the coordinate p in [−1, 1) of a column or a row of a picture whose longest side has `longest` pixels."""
    return 2 * pixel / longest - 1


def waves(p: np.ndarray | float, count: int) -> np.ndarray:
    """Return (…, L, 2): sin(2ᵏπp) and cos(2ᵏπp) for k = 0 … L − 1.

    That is γ(p), Eq. 4 of Mildenhall et al. 2020 (arXiv:2003.08934). The networks of the study get v = (p + 1) / 2 in
    place of p, which changes the sign of the first pair and nothing else.
    """
    angles = np.pi * np.exp2(np.arange(count)) * np.asarray(p, np.float64)[..., None]
    return np.stack([np.sin(angles), np.cos(angles)], -1)


def equation(count: int) -> str:
    """Return γ(p) written out for L = `count`."""
    pairs = [_pair(k) for k in (range(count) if count < 3 else (0, count - 1))]
    return f"γ(p) = ({(', …, ' if count > 2 else ', ').join(pairs)})"


def _power(k: int) -> str:
    return f"2{str(k).translate(SUPERSCRIPT)}"


def _pair(k: int) -> str:
    return f"sin {_power(k)}πp, cos {_power(k)}πp"


class WavePlot:
    """Draws the waves as one strip each over p, and where a pixel's two coordinates cut them."""

    def __init__(self) -> None:
        self._made = 0, 0
        self._rgba = np.zeros((1, 1, 4), np.uint8)

    def draw(self, ui: Ui, count: int, pixel: tuple[int, int], longest: int, height: float) -> None:
        """Draw the equation, the strips and the bar codes of the pixel's column and row in this height."""
        begin, line = imgui.get_cursor_pos_y(), imgui.get_text_line_height_with_spacing()
        imgui.text_wrapped(equation(count))
        imgui.set_item_tooltip(tr("Positional encoding: Mildenhall et al. 2020, Eq. 4"))
        height -= imgui.get_cursor_pos_y() - begin
        room = imgui.get_content_region_avail().x
        row = min(max((height - 3.6 * line) / (2 * count), ROW_EM[0] * ui.em), ROW_EM[1] * ui.em)
        row = max(float(int(row)), 2.0)  # whole pixels: the rows are then of one height
        label, cell, gap = LABEL_EM * ui.em, CELL_EM * ui.em, GAP_EM * ui.em
        wide = max(room - label - 2 * (cell + gap), 2 * ui.em)
        at = imgui.get_cursor_screen_pos()
        left, top = at.x + label, at.y + line
        draw, muted = imgui.get_window_draw_list(), packed(ui.theme.muted)
        high = 2 * count * row
        p = tuple(place(one, longest) for one in pixel)
        columns = tuple(left + wide + gap + k * (cell + gap) for k in range(2))
        if not imgui.is_rect_visible(ImVec2(room, line + high)):  # scrolled away
            imgui.dummy(ImVec2(room, line + high))
            _legend(ui, count, p)
            return
        draw.add_text(ImVec2(left, at.y), muted, "p = −1")
        end = imgui.calc_text_size("1").x
        draw.add_text(ImVec2(left + wide - end, at.y), muted, "1")
        self._make(count, longest)
        texture = ui.texture("encoding waves", self._rgba, smooth=False)
        draw.add_image(texture, ImVec2(left, top), ImVec2(left + wide, top + high))
        for name, x, one, color in zip("xy", columns, p, (ui.theme.accent, ui.theme.warning), strict=True):
            extent = imgui.calc_text_size(name).x
            draw.add_text(ImVec2(x + (cell - extent) / 2, at.y), packed(color), name)
            _cells(draw, _colors(one, count), x, top, cell, row)
            cut = left + wide * (one + 1) / 2
            draw.add_line(ImVec2(cut, top - 0.3 * ui.em), ImVec2(cut, top + high), packed(color), max(1, ui.em / 8))
        each = 1 if 2 * row > 0.95 * ui.em else int(np.ceil(0.95 * ui.em / (2 * row)))
        for k in range(0, count, each):
            text = f"{_power(k)}π"
            middle = top + (2 * k + 1) * row - 0.5 * ui.em
            color = packed(ui.theme.error) if _too_fine(k, longest) else muted
            draw.add_text(ImVec2(left - imgui.calc_text_size(text).x - gap, middle), color, text)
        imgui.dummy(ImVec2(room, line + high))
        ui.mark("encoding.waves")
        self._tooltip(ui, count, p, longest, (left, top, wide, row), columns)
        _legend(ui, count, p)

    def _make(self, count: int, longest: int) -> None:
        """Paint the strips, two rows for each frequency, one column for each pixel of the picture."""
        if self._made == (count, longest):
            return
        self._made = count, longest
        values = waves(place(np.arange(longest), longest), count)  # pyright: ignore[reportArgumentType]: an array
        rgb = colored(values.reshape(longest, -1).T, -1, 1, "signed")
        opaque = np.ones((*rgb.shape[:2], 1))
        self._rgba = np.round(255 * np.concatenate([rgb, opaque], -1)).astype(np.uint8)

    def _tooltip(
        self,
        ui: Ui,
        count: int,
        p: tuple[float, ...],
        longest: int,
        strip: tuple[float, float, float, float],
        columns: tuple[float, ...],
    ) -> None:
        """Name the wave under the mouse and its value."""
        if not imgui.is_item_hovered():
            return
        mouse, (left, top, wide, row) = imgui.get_mouse_pos(), strip
        number = int((mouse.y - top) // row)
        if not 0 <= number < 2 * count:
            return
        cell = CELL_EM * ui.em
        chosen = [one for one, x in zip(p, columns, strict=True) if x <= mouse.x < x + cell]
        if left <= mouse.x < left + wide:
            chosen = [2 * (mouse.x - left) / wide - 1]
        for one in chosen:
            name = "sin" if number % 2 == 0 else "cos"
            value = float(waves(one, count).reshape(-1)[number])
            text = f"{name}({_power(number // 2)}π · {_signed(one)}) = {_signed(value)}"
            fine = tr("finer than the training pixels: between them, the network may draw anything")
            imgui.set_tooltip(f"{text}\n{fine}" if _too_fine(number // 2, longest) else text)


def _too_fine(k: int, longest: int) -> bool:
    """Whether the training pixels, every second one, cannot hold this wave, of 2ᵏ cycles in the picture."""
    return 2**k > longest / 4


def _signed(value: float) -> str:
    return figure(round(value, 3) or 0.0, ".3f").replace("-", "−")


@lru_cache(maxsize=4)  # two coordinates of the pixel, in two places
def _colors(p: float, count: int) -> list[int]:
    """Return the packed colours of the 2L numbers of one coordinate."""
    return tints(colored(waves(p, count).reshape(-1), -1, 1, "signed"))


def _cells(draw: imgui.ImDrawList, colors: list[int], x: float, top: float, wide: float, row: float) -> None:
    for k, color in enumerate(colors):
        low = ImVec2(x, top + k * row)
        draw.add_rect_filled(low, ImVec2(x + wide, low.y + max(row - 1, 1)), color)


def _legend(ui: Ui, count: int, p: tuple[float, ...]) -> None:
    at, draw = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    x, muted = at.x, packed(ui.theme.muted)
    for text in ("−1", "", "1"):
        if text:
            draw.add_text(ImVec2(x, at.y), muted, text)
            x += imgui.calc_text_size(text).x + 0.3 * ui.em
        else:
            color_scale(draw, ImVec2(x, at.y + 0.2 * ui.em), ImVec2(x + 3 * ui.em, at.y + 0.85 * ui.em), "signed")
            x += 3.3 * ui.em
    imgui.set_cursor_screen_pos(ImVec2(x + 0.6 * ui.em, at.y))
    place = tr("the pixel at ({x}, {y}) becomes {n} numbers")
    hint(ui, place.format(x=_signed(p[0]), y=_signed(p[1]), n=4 * count))


def bar_code(ui: Ui, count: int, pixel: tuple[int, int], longest: int, wide: float) -> None:
    """Draw the 4L numbers of a pixel as two lines of bars, x above y, in the signed colour map."""
    draw, label, high = imgui.get_window_draw_list(), 1.2 * ui.em, 0.8 * ui.em
    for name, one, color in zip("xy", pixel, (ui.theme.accent, ui.theme.warning), strict=True):
        at = imgui.get_cursor_screen_pos()
        draw.add_text(ImVec2(at.x, at.y - 0.15 * ui.em), packed(color), name)
        bar = (wide - label) / (2 * count)
        for k, shade in enumerate(_colors(place(one, longest), count)):
            low = ImVec2(at.x + label + k * bar, at.y)
            draw.add_rect_filled(low, ImVec2(low.x + max(bar - 1, 1), at.y + high), shade)
        imgui.dummy(ImVec2(wide, high))
