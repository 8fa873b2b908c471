"""A small picture that the reader paints with the mouse."""

from __future__ import annotations

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import tr

from ..ui.contract import Ui
from ..ui.widgets import color_of, packed

SIDE = 128  # pixels: what the study learns by default, so nothing is averaged
WHITE = (255, 255, 255)
MOST_UNDO = 20
CELL = 8  # pixels of a square of the checkerboard
WIDEST, FINEST = 64.0, 4.0  # pixels of the first and the last pair of stripes

Point = tuple[float, float]  # column, row in pixels: pixel i reaches from i to i + 1


class PaintCanvas:
    """A picture with a brush.

    Attributes:
        pixels: (SIDE, SIDE, 3) uint8 sRGB; another array after every change.
        color: of the brush.
        brush: its diameter in pixels.
    """

    def __init__(self) -> None:
        self.color: tuple[int, int, int] = (0, 0, 0)
        self.brush = 6.0
        self._undo: list[np.ndarray] = []
        self._last: Point | None = None  # where the stroke under way has come to
        self._show(np.full((SIDE, SIDE, 3), 255, np.uint8))

    def _show(self, pixels: np.ndarray) -> None:
        self.pixels = pixels
        opaque = np.full((SIDE, SIDE, 1), 255, np.uint8)
        self._rgba = np.concatenate([pixels, opaque], -1)

    @property
    def plain(self) -> bool:
        """Whether all pixels have one colour: then there is nothing to learn."""
        return bool((self.pixels == self.pixels[0, 0]).all())

    @property
    def can_undo(self) -> bool:
        return bool(self._undo)

    # ---- what changes it ----------------------------------------------------------------------------------------

    def replace(self, pixels: np.ndarray) -> None:
        """Show another picture (SIDE, SIDE, 3) uint8; `undo` brings this one back."""
        self._undo = [*self._undo[1 - MOST_UNDO :], self.pixels]
        self._show(pixels)

    def undo(self) -> None:
        """Take back the last stroke or replacement."""
        if self._undo:
            self._show(self._undo.pop())

    def stroke(self, begin: Point, end: Point) -> None:
        """Paint a straight line with round ends. Its edge is blended over one pixel."""
        at = np.arange(SIDE) + 0.5  # the middles of the pixels
        (x, y), (dx, dy) = begin, (end[0] - begin[0], end[1] - begin[1])
        along = ((at - x) * dx + (at[:, None] - y) * dy) / max(dx * dx + dy * dy, 1e-9)
        along = np.clip(along, 0, 1)
        distance = np.hypot(at - x - along * dx, at[:, None] - y - along * dy)
        cover = np.clip(self.brush / 2 + 0.5 - distance, 0, 1)[..., None]
        mixed = self.pixels + cover * (np.array(self.color, np.float64) - self.pixels)
        self._show(np.round(mixed).astype(np.uint8))

    # ---- the widget ---------------------------------------------------------------------------------------------

    def draw(self, ui: Ui, side: float, mark: str) -> None:
        """Draw the canvas `side` pixels wide, and paint where the left button is held on it."""
        corner = imgui.get_cursor_screen_pos()
        far = ImVec2(corner.x + side, corner.y + side)
        imgui.invisible_button(mark, ImVec2(side, side))
        ui.mark(mark)
        mouse, scale = imgui.get_mouse_pos(), SIDE / side
        here = (mouse.x - corner.x) * scale, (mouse.y - corner.y) * scale
        if imgui.is_item_activated():
            self.replace(self.pixels)
            self._last = here
        if imgui.is_item_active() and self._last is not None:
            if here != self._last or imgui.is_item_activated():
                self.stroke(self._last, here)
            self._last = here
        drawn = imgui.get_window_draw_list()
        drawn.add_image(ui.texture("encoding canvas", self._rgba), corner, far)
        drawn.add_rect(corner, far, packed(ui.theme.hairline))
        if self.plain and not imgui.is_item_active():
            text = tr("Paint here with the mouse.")
            extent = imgui.calc_text_size(text, wrap_width=0.9 * side)
            middle = ImVec2(corner.x + (side - extent.x) / 2, corner.y + (side - extent.y) / 2)
            drawn.add_text(imgui.get_font(), ui.em, middle, packed(color_of((0.45,) * 3)), text, wrap_width=0.9 * side)
        if imgui.is_item_hovered() or imgui.is_item_active():
            drawn.push_clip_rect(corner, far, True)
            drawn.add_circle(mouse, self.brush / 2 / scale, packed(ui.theme.accent), 0, max(1.0, ui.em / 12))
            drawn.pop_clip_rect()


def blank() -> np.ndarray:
    """Return a white picture."""
    return np.full((SIDE, SIDE, 3), 255, np.uint8)


def stripes() -> np.ndarray:
    """Return black and white stripes that grow finer from left to right: each network follows them so far, and blurs.

    The frequency grows exponentially from 1 / WIDEST to 1 / FINEST cycles per pixel.
    """
    x = (np.arange(SIDE) + 0.5) / SIDE
    growth = np.log(WIDEST / FINEST)
    cycles = SIDE / WIDEST * np.expm1(growth * x) / growth  # the integral of the frequency
    row = np.where(np.cos(2 * np.pi * cycles) > 0, 255, 0).astype(np.uint8)
    return np.broadcast_to(row[None, :, None], (SIDE, SIDE, 3)).copy()


def checker() -> np.ndarray:
    """Return a checkerboard of two colours."""
    odd = np.add.outer(np.arange(SIDE) // CELL, np.arange(SIDE) // CELL) % 2 == 1
    return np.where(odd[..., None], (0, 114, 178), (240, 228, 66)).astype(np.uint8)
