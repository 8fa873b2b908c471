"""Average and composite photos, in float and with premultiplied colour."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

Decode = Callable[[np.ndarray], np.ndarray]


class Rows(Protocol):
    """What is read of a photo: its shape (H, W, C), and a slice of its rows as an array."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, rows: slice, /) -> np.ndarray: ...


ROWS_AT_ONCE = 64  # input rows at least: few enough to stay in the processor's cache
PIXELS_AT_ONCE = 1 << 16  # of narrow photos, whose rows would cost more by their number than by their pixels
BAND_BYTES = 8_000_000  # of float rows in work at once: a whole large photo in float would take gigabytes


def composite(pixels: Rows, size: tuple[int, int], background: tuple[float, float, float]) -> np.ndarray:
    """Average a photo to a size and composite it over a background.

    Colour is premultiplied before it is averaged, so that invisible colour does not bleed into edges:
    C = mean(α c) + (1 − mean α) · background.

    Args:
        pixels: (H, W, C) uint8, uint16 (full range = 1) or float32; C is 1 for grey, 2 for grey and alpha, 3 for RGB,
            4 for RGBA, with straight alpha.
        size: (width, height) in pixels.
        background: an sRGB colour.

    Returns:
        uint16 (height, width, 3), 65535 = 1.
    """
    width, height = size
    result, done = np.empty((height, width, 3), np.uint16), 0
    for band in _bands(averaged_blocks(pixels, height, _premultiplied)):
        mean = band
        if width != pixels.shape[1]:
            mean = average_rows(band.transpose(1, 0, 2), width, lambda columns: columns).transpose(1, 0, 2)
        color = mean[..., :3]
        if mean.shape[2] == 4:
            color = color + (1 - mean[..., 3:]) * np.asarray(background, np.float32)
        result[done : done + len(color)] = np.clip(color, 0, 1) * 65535 + 0.5
        done += len(color)
    return result


def composite_bytes(shape: tuple[int, ...], size: tuple[int, int]) -> int:
    """Return the most bytes that `composite` takes, with its result and without the photo.

    The result has 6 bytes a pixel. The float rows that are in work stand in a few copies: how many was measured.

    Args:
        shape: (rows, columns) of the photo.
        size: (width, height) of the result.
    """
    (rows, columns), (width, height) = shape, size
    float_row = 4 * 4 * columns  # of at most four channels
    block = float_row * min(rows, max(ROWS_AT_ONCE, PIXELS_AT_ONCE // columns, -(-rows // height)))
    return 6 * width * height + 2 * block + 5 * min(float_row * height, BAND_BYTES + block)


def _bands(blocks: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Join blocks of rows into bands of about BAND_BYTES, because many small blocks cost time and one costs memory."""
    waiting: list[np.ndarray] = []
    total = 0
    for block in blocks:
        waiting.append(block)
        total += block.nbytes
        if total >= BAND_BYTES:
            band = np.concatenate(waiting)
            waiting, total = [], 0  # before the band is worked on, because it is a copy
            yield band
    if waiting:
        yield np.concatenate(waiting)


def average_rows(image: np.ndarray, count: int, decode: Decode) -> np.ndarray:
    """Average the rows of an image (H, W, C) exactly by area → (count, W, C'), count ≤ H.

    Output row r is the mean of the input rows over [r·H/count, (r+1)·H/count); a row at an end counts by the part that
    is covered. `decode` turns a few input rows into float32 with C' channels.
    """
    return np.concatenate(list(averaged_blocks(image, count, decode)))


def averaged_blocks(image: Rows, count: int, decode: Decode) -> Iterator[np.ndarray]:
    """Yield the result of `average_rows` a few rows at a time, from the top."""
    rows = image.shape[0]
    at_once = max(1, max(ROWS_AT_ONCE, PIXELS_AT_ONCE // image.shape[1]) * count // rows)
    for start in range(0, count, at_once):
        r = np.arange(start, min(start + at_once, count))
        first, last = r * rows // count, -(-(r + 1) * rows // count)
        block = decode(image[first[0] : last[-1]])
        mean = np.zeros((len(r), *block.shape[1:]), np.float32)
        for tap in range(int((last - first).max())):  # a matrix product would start BLAS threads that compete with ours
            i = first + tap
            covered = np.minimum((i + 1) * count, (r + 1) * rows) - np.maximum(i * count, r * rows)
            weights = (np.maximum(covered, 0) / rows).astype(np.float32)
            mean += weights[:, None, None] * block[np.minimum(i - first[0], len(block) - 1)]
        yield mean


def _premultiplied(rows: np.ndarray) -> np.ndarray:
    """Convert (n, W, 1…4) of any pixel type to float32 (n, W, 3 or 4) with colour multiplied by alpha."""
    full = 1.0 if rows.dtype == np.float32 else float(np.iinfo(rows.dtype).max)
    values = rows.astype(np.float32)
    values *= np.float32(1 / full)
    if values.shape[2] <= 2:
        values = np.concatenate([np.repeat(values[..., :1], 3, axis=2), values[..., 1:]], axis=2)
    if values.shape[2] == 4:
        values[..., :3] *= values[..., 3:]
    return values


def srgb_encoded(linear: np.ndarray) -> np.ndarray:
    """Encode linear colour with the sRGB curve (IEC 61966-2-1), clipped to [0, 1]."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)
