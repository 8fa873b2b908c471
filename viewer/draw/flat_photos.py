"""The photos of Flatland as strips: of each camera the photo above, and what is learnt of it below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.lab.flatland.view import FlatView

from ..ui.widgets import packed
from .flat_map import Chosen
from .opaque import OpaquePictures

if TYPE_CHECKING:
    from ..ui.contract import Ui

GUTTER_EM = 0.9  # width of the column with the cameras' signs
PAIR_EM = 0.22, 1.6  # least and largest height of a pair of strips


def by_angle(view: FlatView) -> np.ndarray:
    """Return the cameras' numbers in the order in which they stand on the ring."""
    return np.argsort(np.arctan2(view.cameras[:, 1], view.cameras[:, 0]) % (2 * np.pi))


def strips_height(ui: Ui, view: FlatView, room: float) -> float:
    """Return how high the strips are of the room that there is, in pixels."""
    low, high = PAIR_EM
    return len(view.cameras) * float(np.clip(room / len(view.cameras), low * ui.em, high * ui.em))


class FlatPhotos:
    """The strips of all cameras, in the order in which they stand on the ring."""

    def __init__(self) -> None:
        self._of: tuple[np.ndarray, np.ndarray] | None = None
        self._rows = np.zeros((2, 1, 3), np.uint8)
        self._opaque = OpaquePictures()

    def draw(self, ui: Ui, view: FlatView, size: tuple[float, float], chosen: Chosen) -> Chosen | None:
        """Draw them into a size in pixels, and return what the mouse chooses."""
        order, (wide, high) = by_angle(view), size
        if self._of is None or self._of[0] is not view.photos or self._of[1] is not view.learnt:
            self._of = view.photos, view.learnt
            pairs = np.stack([view.photos[order], view.learnt[order]], 1)
            self._rows = pairs.reshape(-1, *pairs.shape[2:])
        at, gutter = imgui.get_cursor_screen_pos(), GUTTER_EM * ui.em
        imgui.invisible_button("flatland.photos", ImVec2(wide, high))
        ui.mark("flatland.photos")
        draw, low, far = imgui.get_window_draw_list(), ImVec2(at.x + gutter, at.y), ImVec2(at.x + wide, at.y + high)
        rows = self._opaque.rgba("rows", self._rows)
        draw.add_image(ui.texture("flatland photos", rows, smooth=False), low, far)
        pair, pixels = high / len(order), view.photos.shape[1]
        for k, camera in enumerate(order.tolist()):
            top, middle = at.y + k * pair, at.y + (k + 0.5) * pair
            if k:
                gap = max(1.0, 0.07 * ui.em)
                draw.add_rect_filled(
                    ImVec2(low.x, top - gap / 2), ImVec2(far.x, top + gap / 2), packed(ui.theme.surface)
                )
            sign, r = ImVec2(at.x + 0.35 * ui.em, middle), min(0.22 * ui.em, 0.4 * pair)
            if camera < view.training:
                draw.add_circle_filled(sign, r, packed(ui.theme.ray if camera == chosen.camera else ui.theme.text))
            else:
                color = packed(ui.theme.ray if camera == chosen.camera else ui.theme.muted)
                draw.add_circle(sign, r, color, thickness=max(1.0, 0.08 * ui.em))
            if camera == chosen.camera and chosen.pixel is not None:
                x = low.x + (chosen.pixel + 0.5) / pixels * (far.x - low.x)
                half = max(2.0, 0.5 * (far.x - low.x) / pixels)
                corners = ImVec2(x - half, top), ImVec2(x + half, top + pair)
                draw.add_rect(*corners, packed(ui.theme.ray), thickness=max(1.0, 0.1 * ui.em))
        if not imgui.is_item_hovered():
            return None
        mouse = imgui.get_mouse_pos()
        row = int(np.clip((mouse.y - at.y) / pair, 0, len(order) - 1))
        if mouse.x < low.x:
            return Chosen(int(order[row]), None)
        return Chosen(int(order[row]), int(np.clip((mouse.x - low.x) / (far.x - low.x) * pixels, 0, pixels - 1)))
