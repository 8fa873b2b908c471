"""A stack of small pictures, from front to back, with the place where a ray meets each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.common.language import figure, tr, trn
from nerf_core.methods.stages import Pictures

from ..ui.widgets import faded, packed

if TYPE_CHECKING:
    from ..ui.contract import Ui

LEAST_SHARE, STEP_SHARE = 0.62, 0.12  # of the space's sides: a card of a large stack; by how much each card shrinks all
MOST_STEP = 0.3  # of a card's sides: how far the next one is moved
CHECK_EM = 0.6  # side of a square of the ground under a transparent picture
DARK, LIGHT = ImVec4(0.16, 0.16, 0.17, 1), ImVec4(0.24, 0.24, 0.25, 1)  # its squares
BEHIND = 0.35  # opacity of the other pictures while one is in front
LARGE_EM = 18.0  # longer side of a picture in a tooltip


def cards(sizes: Sequence[tuple[int, int]], room: tuple[float, float]) -> np.ndarray:
    """Place pictures like cards: the first lies in front at the lower left, the last behind at the upper right.

    Args:
        sizes: width and height of each of N pictures, in pixels. All are drawn at one scale.
        room: width and height of the space.

    Returns:
        (N, 4) left, top, right and bottom of each card within the space.
    """
    count, size = len(sizes), np.array(sizes, np.float64).reshape(-1, 2)
    largest, room_ = size.max(0), np.array(room, np.float64)
    share = max(LEAST_SHARE, 1 - STEP_SHARE * (count - 1))
    scale = float((share * room_ / largest).min())
    step = np.minimum((room_ - scale * largest) / max(count - 1, 1), MOST_STEP * scale * largest) * (count > 1)
    k = np.arange(count)
    low = np.stack([k * step[0], (count - 1 - k) * step[1] + scale * (largest[1] - size[:, 1])], -1)
    return np.concatenate([low, low + scale * size], -1)


def picture_stack(ui: Ui, key: str, chart: Pictures, room: tuple[float, float]) -> int | None:
    """Draw the stack and a line with the names below it.

    The picture under the mouse comes to the front, and a tooltip shows it larger.

    Args:
        ui: where to draw.
        key: unique in the window; textures are kept under it.
        chart: the pictures.
        room: width and height, in pixels, without the line below.

    Returns:
        The index of the picture under the mouse, else None.
    """
    at, draw = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    imgui.invisible_button(key, ImVec2(max(room[0], 1.0), max(room[1], 1.0)))
    over = imgui.is_item_hovered()
    ui.mark(f"walk.pictures {key.removeprefix('##')}")
    if not chart.images:
        imgui.text_colored(ui.theme.muted, tr("no pictures"))
        return None
    boxes = cards([(image.shape[1], image.shape[0]) for image in chart.images], room)
    boxes += np.array([at.x, at.y, at.x, at.y])
    hovered = _under(boxes, imgui.get_mouse_pos()) if over else None
    for k in reversed(range(len(boxes))):
        alpha = 1.0 if hovered is None or len(boxes) == 1 else BEHIND
        _card(ui, draw, f"{key} {k}", chart.images[k], boxes[k], ground=len(boxes) == 1, alpha=alpha)
        if hovered is None:
            _mark(ui, draw, chart, k, boxes[k])
    if hovered is None:
        _way(ui, draw, chart, boxes)
    else:
        _card(ui, draw, f"{key} {hovered}", chart.images[hovered], boxes[hovered], ground=True)
        _mark(ui, draw, chart, hovered, boxes[hovered])
        _enlarged(ui, f"{key} {hovered}", chart, hovered)
    imgui.text_colored(ui.theme.muted, _fitting(_names(chart, hovered), room[0]))
    return hovered


def _enlarged(ui: Ui, key: str, chart: Pictures, k: int) -> None:
    """Picture k in a tooltip, with its name."""
    image = chart.images[k]
    box = cards([(image.shape[1], image.shape[0])], (LARGE_EM * ui.em, LARGE_EM * ui.em))[0]
    if not imgui.begin_tooltip():
        return
    at = imgui.get_cursor_screen_pos()
    imgui.dummy(ImVec2(float(box[2]), float(box[3])))
    box = box + np.array([at.x, at.y, at.x, at.y])
    _card(ui, imgui.get_window_draw_list(), key, image, box, ground=True)
    _mark(ui, imgui.get_window_draw_list(), chart, k, box)
    imgui.text_colored(ui.theme.muted, _fitting(chart.names[k], LARGE_EM * ui.em))
    imgui.end_tooltip()


def _under(boxes: np.ndarray, mouse: ImVec2) -> int | None:
    """The foremost card that contains a point."""
    inside = (boxes[:, 0] <= mouse.x) & (mouse.x < boxes[:, 2]) & (boxes[:, 1] <= mouse.y) & (mouse.y < boxes[:, 3])
    return int(inside.argmax()) if inside.any() else None


def _card(
    ui: Ui, draw: imgui.ImDrawList, key: str, image: np.ndarray, box: np.ndarray, ground: bool, alpha: float = 1.0
) -> None:
    """A picture with a hairline around it. ground: with a checkered ground under what is transparent."""
    low, high = ImVec2(*box[:2].tolist()), ImVec2(*box[2:].tolist())
    if ground and image[..., 3].min() < 255:
        _checkers(ui, draw, low, high)
    tint = packed(ImVec4(1, 1, 1, alpha))
    draw.add_image(ui.texture(key, image), low, high, ImVec2(0, 0), ImVec2(1, 1), tint)
    draw.add_rect(low, high, packed(faded(ui.theme.muted, 0.6 * alpha)))


def _checkers(ui: Ui, draw: imgui.ImDrawList, low: ImVec2, high: ImVec2) -> None:
    side = CHECK_EM * ui.em
    draw.add_rect_filled(low, high, packed(DARK))
    light = packed(LIGHT)
    for row, top in enumerate(np.arange(low.y, high.y, side).tolist()):
        for left in np.arange(low.x + (row % 2) * side, high.x, 2 * side).tolist():
            draw.add_rect_filled(ImVec2(left, top), ImVec2(min(left + side, high.x), min(top + side, high.y)), light)


def _place(chart: Pictures, k: int, box: np.ndarray) -> ImVec2 | None:
    """Where on the screen the ray meets picture k; None: it does not."""
    place, image = chart.marks[k], chart.images[k]
    if not np.isfinite(place).all():
        return None
    x, y = box[:2] + place / (image.shape[1], image.shape[0]) * (box[2:] - box[:2])
    return ImVec2(float(x), float(y))


def _mark(ui: Ui, draw: imgui.ImDrawList, chart: Pictures, k: int, box: np.ndarray) -> None:
    at = _place(chart, k, box)
    if at is None:
        return
    r = (0.4 if len(chart.images) <= 8 else 0.25) * ui.em
    for color, width in ((ui.theme.surface, 0.25 * ui.em), (ui.theme.ray, 0.1 * ui.em)):
        draw.add_circle(at, r, packed(color), thickness=width)


def _way(ui: Ui, draw: imgui.ImDrawList, chart: Pictures, boxes: np.ndarray) -> None:
    """The ray from card to card."""
    places = [_place(chart, k, boxes[k]) for k in range(len(boxes))]
    for a, b in pairwise(places):
        if a is not None and b is not None:
            draw.add_line(a, b, packed(faded(ui.theme.ray, 0.6)), max(1.0, 0.07 * ui.em))


def _names(chart: Pictures, hovered: int | None) -> str:
    count = len(chart.names)
    if count == 1:
        return chart.names[0]
    if hovered is not None:
        numbers = {"i": figure(hovered + 1, ","), "total": figure(count, ",")}
        return tr("{i} of {total}: {name}").format(name=tr(chart.names[hovered]), **numbers)
    return trn("{n} picture, front to back", "{n} pictures, front to back", count)


def _fitting(text: str, width: float) -> str:
    """Cut a text short so that it is at most so many pixels wide."""
    if imgui.calc_text_size(text).x <= width:
        return text
    kept = next((k for k in range(len(text), 0, -1) if imgui.calc_text_size(f"{text[:k]}…").x <= width), 0)
    return f"{text[:kept].rstrip()}…"
