"""The film of Flatland being learnt: the learnt field beside the true one, and a held-out photo of both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerf_core.common.assets import assets_dir
from nerf_core.rendering.video import VideoWriter

FPS = 20
SIDE, STRIP, GAP, LINE = 320, 20, 16, 26  # sizes of a frame's parts in pixels
PAGE, INK, MUTED = (22, 24, 29), (230, 232, 236), (150, 156, 166)
LAST = FPS  # the last frame stays for a second


def frame_size() -> tuple[int, int]:
    """Return the width and the height of a frame in pixels."""
    return 3 * GAP + 2 * SIDE, 2 * GAP + 2 * LINE + SIDE + STRIP


def write_film(
    file: Path,
    fields: list[np.ndarray],
    photos: list[np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    labels: list[str],
) -> Iterator[None]:
    """Write the film, a frame a piece.

    Args:
        file: an MP4.
        fields: of each frame, the learnt field (S, S, 3) uint8.
        photos: of each frame, the held-out photo as it is learnt (W, 3) uint8.
        truth: the true field and the true photo.
        labels: of each frame, a line.

    Raises:
        UserError: it cannot be written.
    """
    from PIL import ImageFont

    font = ImageFont.truetype(assets_dir() / "fonts" / "Roboto-Regular.ttf", 15)
    with VideoWriter(file, FPS, *frame_size()) as video:
        for k, (field, photo, label) in enumerate(zip(fields, photos, labels, strict=True)):
            frame = _frame(field, photo, *truth, label, font)
            for _ in range(LAST if k == len(fields) - 1 else 1):
                video.add(frame)
            yield


def _frame(
    field: np.ndarray, photo: np.ndarray, true_field: np.ndarray, true_photo: np.ndarray, label: str, font: object
) -> np.ndarray:
    from PIL import Image, ImageDraw

    page = Image.new("RGB", frame_size(), PAGE)
    draw = ImageDraw.Draw(page)
    sides = ((field, photo, f"learnt: {label}"), (true_field, true_photo, "the world"))
    for k, (square, line, name) in enumerate(sides):
        left, top = GAP + k * (SIDE + GAP), GAP + LINE
        draw.text((left, GAP), name, INK, font)  # pyright: ignore[reportArgumentType]
        page.paste(Image.fromarray(square).resize((SIDE, SIDE), Image.Resampling.BICUBIC), (left, top))
        strip = Image.fromarray(line[None]).resize((SIDE, STRIP), Image.Resampling.NEAREST)
        page.paste(strip, (left, top + SIDE + LINE))
        draw.text((left, top + SIDE + 5), "photo of a held-out camera", MUTED, font)  # pyright: ignore[reportArgumentType]
    return np.asarray(page)
