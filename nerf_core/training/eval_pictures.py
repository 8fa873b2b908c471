"""The pictures of `nerf-core eval`: a photo, its rendering and the error side by side, and the names of their files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerf_core.common.assets import assets_dir
from nerf_core.common.colormaps import colored
from nerf_core.datasets.images import SUFFIXES
from nerf_core.rendering.images import to_bytes

PAGE, INK = (251, 251, 250), (29, 31, 33)
MOST_ERROR = 0.2  # of the range of colours: the brightest colour of the error; larger ones hide where details differ
LETTERS = 40  # of a label, in widths of its font's size, fit above a photo
SMALLEST, LARGEST = 12, 120  # pixels: the size of the labels; 100 of a sheet of 12,144 are 16 of a screen of 1,920


def side_by_side(color: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, psnr: float) -> np.ndarray:
    """Draw a photo, its rendering and the error side by side, each with a label above.

    The error of a pixel is the mean of |rendering − photo| over its channels.

    Args:
        color: (H, W, 3) the rendering, in [0, 1].
        truth: (H, W, 3) the photo, in [0, 1].
        mask: (H, W) bool: the pixels that are compared; the error of the others is left blank. None: all.
        psnr: of the rendering, in dB.

    Returns:
        (h, w, 3) uint8; the three parts have the photo's own pixels.
    """
    from PIL import Image, ImageDraw, ImageFont

    high, wide = truth.shape[:2]
    size = min(max(SMALLEST, wide // LETTERS), LARGEST)
    font = ImageFont.truetype(assets_dir() / "fonts" / "Roboto-Regular.ttf", size)
    error = to_bytes(colored(np.abs(color - truth).mean(-1), 0, MOST_ERROR, "inferno"))
    if mask is not None:
        error[~mask] = PAGE
    parts = (
        ("photo", to_bytes(truth)),
        (f"rendering, {psnr:.1f} dB", to_bytes(color)),
        (f"error: black 0, yellow {MOST_ERROR:g} and more", error),
    )
    column = max(wide, *(round(font.getlength(label)) for label, _ in parts))
    page = Image.new("RGB", (3 * column + 4 * size, high + 3 * size), PAGE)
    draw = ImageDraw.Draw(page)
    for k, (label, pixels) in enumerate(parts):
        left = size + k * (column + size)
        draw.text((left, size), label, INK, font, anchor="lm")
        page.paste(Image.fromarray(pixels), (left, 2 * size))
    return np.asarray(page)


def picture_names(names: Sequence[str]) -> dict[str, str]:
    """Return the file of each view's picture: the view's name with the suffix .png instead of its own.

    If two pictures would share a file, all names keep their suffix: a.jpg and a.tif become a.jpg.png and a.tif.png.
    Names that differ only in capitals, which some disks do not distinguish, are numbered as well.

    Args:
        names: of all views.
    """
    for files in ([f"{_stem(name)}.png" for name in names], [f"{name}.png" for name in names]):
        if len({file.casefold() for file in files}) == len(names):
            return dict(zip(names, files, strict=True))
    return {name: f"{name}-{k}.png" for k, name in enumerate(names)}


def _stem(name: str) -> str:
    """A name without the suffix of a photo; one with another dot keeps what follows it."""
    stem, dot, end = name.rpartition(".")
    return stem if dot and f".{end.lower()}" in SUFFIXES else name
