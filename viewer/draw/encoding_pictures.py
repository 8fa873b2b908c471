"""Pictures of one place side by side: a row of them, and the same small part of each, enlarged, under the mouse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.common.language import tr

from ..ui.contract import Ui
from ..ui.widgets import mono, packed
from .opaque import OpaquePictures

ZOOMED = 20  # pixels of a side of the enlarged part
ZOOM_EM = 6.0  # its side on the screen
GAP_EM = 0.5  # between pictures
LINE_EM = 0.2  # height of the line under a picture, in the colour of its curve
TIP_EM = 13.0  # height of the enlarged parts with what is under them


class Shown(NamedTuple):
    """A picture of the row.

    name: of its texture and its mark; it stays.
    image: (h, w, 3) uint8; None: there is none yet.
    captions: under it, the first that fits its width.
    notes: under that, in figures, likewise.
    color: of its curve; None: it has none.
    """

    name: str
    image: np.ndarray | None
    captions: tuple[str, ...]
    notes: tuple[str, ...] = ("",)
    color: ImVec4 | None = None


class PictureRow:
    """Draws rows of pictures of one size, and shows what the mouse points at in all of them.

    pixel: the column and row that the mouse pointed at last; None: not yet.
    top: the panel's upper edge on the screen: enlarged parts lie above it, so that they cover nothing of the panel.
    """

    def __init__(self) -> None:
        self.pixel: tuple[int, int] | None = None
        self.top = 0.0
        self._opaque = OpaquePictures()

    def texture(self, ui: Ui, name: str, image: np.ndarray, smooth: bool = True) -> imgui.ImTextureRef:
        # a texture has one filter: the enlarged one, whose pixels are to be seen, is another
        rgba = self._opaque.rgba(name, image)
        return ui.texture(f"encoding {name}{'' if smooth else ' zoomed'}", rgba, smooth)

    def draw(
        self,
        ui: Ui,
        pictures: Sequence[Shown],
        size: tuple[float, float],
        zoom: Callable[[tuple[int, int]], None] | None = None,
        captions: bool = True,
    ) -> None:
        """Draw pictures side by side with their captions, `size` (width, height) each.

        zoom: draws more about a pixel under the enlarged parts; None: nothing is enlarged, as for spectra.
        """
        corners, hovered, right = [], False, imgui.get_cursor_screen_pos().x + imgui.get_content_region_avail().x
        for k, one in enumerate(pictures):
            if k and imgui.get_item_rect_max().x + GAP_EM * ui.em + size[0] <= right + 1:
                imgui.same_line(0, GAP_EM * ui.em)
            imgui.begin_group()
            corner = imgui.get_cursor_screen_pos()
            corners.append(corner)
            if one.image is None:
                _empty(ui, corner, size)
            else:
                imgui.image(self.texture(ui, one.name, one.image), ImVec2(*size))
                if imgui.is_item_hovered() and zoom is not None:
                    hovered = True
                    self.pixel = _pixel(one.image, corner, size)
            ui.mark(f"encoding.{one.name}")
            if captions:
                low = imgui.get_item_rect_max().y
                if one.color is not None:
                    high = ImVec2(corner.x + size[0], low + LINE_EM * ui.em)
                    imgui.get_window_draw_list().add_rect_filled(ImVec2(corner.x, low), high, packed(one.color))
                imgui.set_cursor_screen_pos(ImVec2(corner.x, low + 2 * LINE_EM * ui.em))
                _caption(ui, one, size[0])
            imgui.end_group()
        if hovered and zoom is not None and self.pixel is not None:
            self._outline(ui, pictures, corners, size)
            self._zoomed(ui, pictures, zoom)

    def _outline(self, ui: Ui, pictures: Sequence[Shown], corners: Sequence[ImVec2], size: tuple[float, float]) -> None:
        """Draw in each picture which part of it is enlarged."""
        draw = imgui.get_window_draw_list()
        for one, corner in zip(pictures, corners, strict=True):
            if one.image is not None:
                left, top, right, bottom = _part(one.image, self.pixel or (0, 0))
                low = ImVec2(corner.x + left * size[0], corner.y + top * size[1])
                high = ImVec2(corner.x + right * size[0], corner.y + bottom * size[1])
                draw.add_rect(low, high, packed(ui.theme.accent), 0, max(1.0, ui.em / 12))

    def _zoomed(self, ui: Ui, pictures: Sequence[Shown], more: Callable[[tuple[int, int]], None]) -> None:
        """Show the same part of all pictures, enlarged."""
        assert self.pixel is not None
        side = ZOOM_EM * ui.em
        half = (len(pictures) * (ZOOM_EM + GAP_EM) + 1) / 2 * ui.em
        x = max(min(imgui.get_mouse_pos().x, imgui.get_io().display_size.x - half), half)
        above = self.top > TIP_EM * ui.em
        y = self.top - 0.5 * ui.em if above else imgui.get_mouse_pos().y + 2 * ui.em
        imgui.set_next_window_pos(ImVec2(x, y), 0, ImVec2(0.5, 1.0 if above else 0.0))
        if not imgui.begin_tooltip():
            return
        for k, one in enumerate(pictures):
            if one.image is None:
                continue
            if k:
                imgui.same_line(0, GAP_EM * ui.em)
            imgui.begin_group()
            left, upper, right, lower = _part(one.image, self.pixel)
            corner = imgui.get_cursor_screen_pos()
            image = self.texture(ui, one.name, one.image, smooth=False)
            imgui.image(image, ImVec2(side, side), ImVec2(left, upper), ImVec2(right, lower))
            _cross(ui, one.image, self.pixel, corner, side)
            with mono(ui):
                imgui.text_colored(one.color or ui.theme.muted, one.notes[0] or " ")
            imgui.end_group()
        more(self.pixel)
        imgui.end_tooltip()


def _pixel(image: np.ndarray, corner: ImVec2, size: tuple[float, float]) -> tuple[int, int]:
    """Return the column and row of a picture that the mouse points at."""
    mouse, (high, wide) = imgui.get_mouse_pos(), image.shape[:2]
    column, row = (mouse.x - corner.x) / size[0] * wide, (mouse.y - corner.y) / size[1] * high
    return min(max(int(column), 0), wide - 1), min(max(int(row), 0), high - 1)


def _part(image: np.ndarray, pixel: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return the part around a pixel that is enlarged (left, top, right, bottom), as shares of the picture."""
    high, wide = image.shape[:2]
    side = min(ZOOMED, high, wide)
    left = min(max(pixel[0] - side // 2, 0), wide - side)
    top = min(max(pixel[1] - side // 2, 0), high - side)
    return left / wide, top / high, (left + side) / wide, (top + side) / high


def _cross(ui: Ui, image: np.ndarray, pixel: tuple[int, int], corner: ImVec2, side: float) -> None:
    """Frame the pixel in the enlarged part."""
    high, wide = image.shape[:2]
    left, top, right, bottom = _part(image, pixel)
    share_x = (pixel[0] / wide - left) / (right - left), ((pixel[0] + 1) / wide - left) / (right - left)
    share_y = (pixel[1] / high - top) / (bottom - top), ((pixel[1] + 1) / high - top) / (bottom - top)
    low = ImVec2(corner.x + share_x[0] * side, corner.y + share_y[0] * side)
    far = ImVec2(corner.x + share_x[1] * side, corner.y + share_y[1] * side)
    imgui.get_window_draw_list().add_rect(low, far, packed(ui.theme.accent), 0, max(1.0, ui.em / 12))


def _empty(ui: Ui, corner: ImVec2, size: tuple[float, float]) -> None:
    """Draw the place of a picture that is still to come."""
    draw, text = imgui.get_window_draw_list(), tr("not yet")
    draw.add_rect(corner, ImVec2(corner.x + size[0], corner.y + size[1]), packed(ui.theme.hairline))
    extent = imgui.calc_text_size(text)
    if extent.x < size[0]:
        middle = ImVec2(corner.x + (size[0] - extent.x) / 2, corner.y + (size[1] - extent.y) / 2)
        draw.add_text(middle, packed(ui.theme.muted), text)
    imgui.dummy(ImVec2(*size))


def _caption(ui: Ui, one: Shown, width: float) -> None:
    """Draw the caption and the figure under it. Both are cut at the width."""
    at, draw = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    imgui.push_clip_rect(at, ImVec2(at.x + width, at.y + 4 * ui.em), True)
    draw.add_text(at, packed(ui.theme.text), _fitting(one.captions, width))
    imgui.dummy(ImVec2(width, imgui.get_text_line_height()))
    with mono(ui):
        draw.add_text(imgui.get_cursor_screen_pos(), packed(ui.theme.muted), _fitting(one.notes, width))
    imgui.dummy(ImVec2(width, imgui.get_text_line_height()))
    imgui.pop_clip_rect()


def _fitting(texts: tuple[str, ...], width: float) -> str:
    return next((text for text in texts if imgui.calc_text_size(text).x <= width), texts[-1])
