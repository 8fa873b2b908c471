"""The photos whose poses are being found, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from ..ui.contract import Ui
from ..ui.widgets import packed

GAP_EM = 0.25  # between photos
LARGEST = 2.0  # of a photo's own size: beyond it, pixels show
DIM = 0.35  # brightness of a photo that has not been looked at


def places(count: int, aspect: float, room: tuple[float, float], gap: float) -> np.ndarray:
    """Lay out photos in rows that fill a space as well as they can, in its middle.

    Args:
        count: how many, 1 or more.
        aspect: of the space for each, width by height.
        room: width and height of the space, in pixels.
        gap: between photos, in pixels.

    Returns:
        (count, 4) left, top, right and bottom of each, within the space.
    """
    columns = np.arange(1, count + 1)
    rows = -(-count // columns)
    wide = (room[0] - gap * (columns + 1)) / columns
    high = (room[1] - gap * (rows + 1)) / rows
    width = np.minimum(wide, high * aspect)
    best = int(np.argmax(width))
    across, down, width = int(columns[best]), int(rows[best]), max(float(width[best]), 1.0)
    cell = np.array([width, width / aspect])
    low = (np.array(room) - (cell + gap) * (across, down) + gap) / 2
    at = low + (cell + gap) * np.stack([np.arange(count) % across, np.arange(count) // across], -1)
    return np.concatenate([at, at + cell], -1)


def mosaic(ui: Ui, photos: Sequence[np.ndarray], count: int, seen: float, origin: ImVec2, room: tuple[float, float]) -> None:  # fmt: skip  # noqa: E501
    """Draw photos into a rectangle of the screen.

    Args:
        ui: where to draw.
        photos: (h, w, 4) uint8 each.
        count: as many will come; the others' places stay free.
        seen: the share of them that has been looked at. Others are dim.
        origin, room: the rectangle, in pixels.
    """
    if not photos:
        return
    draw = imgui.get_window_draw_list()
    aspect = float(np.median([photo.shape[1] / photo.shape[0] for photo in photos]))
    boxes = places(max(count, len(photos)), aspect, room, GAP_EM * ui.em)
    bright = math.floor(seen * len(boxes) + 1e-6)  # the product of a share and a count is rounded
    for k, photo in enumerate(photos):
        low, high = boxes[k].reshape(2, 2)
        size = np.array([photo.shape[1], photo.shape[0]])
        half = size * min(float(((high - low) / size).min()), LARGEST) / 2
        first, last = (low + high) / 2 - half + (origin.x, origin.y), (low + high) / 2 + half + (origin.x, origin.y)
        level = 1.0 if k < bright else DIM
        draw.add_image(
            ui.texture(f"mosaic {k}", photo), ImVec2(*first.tolist()), ImVec2(*last.tolist()), ImVec2(0, 0),
            ImVec2(1, 1), packed(ImVec4(level, level, level, 1.0)),
        )  # fmt: skip
