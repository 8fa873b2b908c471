"""Measure one photo: how sharp it is, how it is exposed, and a thumbnail.

Sharpness is the ratio of fine to coarse detail. With Y the encoded luminance at full size, Y₄ its mean over blocks of
4 × 4 pixels, and ∇² the Laplacian of five points,

    s = √(Var ∇²Y / Var ∇²Y₄).

The variance of the Laplacian is the common measure of focus (Pech-Pacheco et al., Diatom autofocusing in brightfield
microscopy, ICPR 2000; compared with 35 others by Pertuz et al., Analysis of focus measure operators, Pattern
Recognition 2013). Alone it grows with contrast and with how much texture a photo shows. Natural pictures have about the
same contrast at every scale (Field, Relations between the statistics of natural images, JOSA A 1987), and blur takes
away the fine one alone. The ratio therefore depends neither on what a photo shows nor on its brightness, and falls with
the blur.
"""

from __future__ import annotations

import io
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from PIL import Image

from nerf_core.geometry.photos import Photos

LONGEST = 2048  # pixels of the longer side that are looked at; phones' finest pixels are noise and sharpening
STRIP = 1 << 17  # pixels of one piece of work: about 5 ms, so that a window that waits is served
COARSE = 4  # two octaves: blur of a few pixels leaves this scale alone
BLANK = 1e-8  # variance of the coarse Laplacian; noise of half of an 8-bit level has more
EXPOSED = 400  # rows and columns, at most, from which exposure is read: a mean of 100,000 pixels needs no more
WHITE, BLACK = 254, 1  # of 255: from here on, a channel has lost its detail
LEAST_LUMINANCE = 1 / 4096  # of white: below this, 12 stops, a photo holds noise
THUMBNAIL, QUALITY = 176, 70  # of a thumbnail: its longer side, and WebP's quality: about 5 kB
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of Rec. 709, which are sRGB's


@dataclass(frozen=True)
class Measure:
    """What one photo says without its pose. See the module and `PhotoFacts`."""

    sharpness: float
    exposure: float
    highlights: float
    shadows: float


def measure_photo(photos: Photos, k: int, ground: tuple[float, float, float] | None) -> Generator[None, None, Measure]:
    """Measure photo k in pieces of a few milliseconds, each of which yields.

    ground: the sRGB colour of pixels that are no part of the picture (a plain background); None: all are.
    """
    width, height = (int(v) for v in photos.sizes[k])
    block = -(-max(width, height) // LONGEST)
    step = max(block * COARSE, STRIP // max(width, 1) // (block * COARSE) * block * COARSE)
    fine, coarse = _Variance(), []
    before = np.empty((0, width // block), np.float32)
    for top in range(0, height, step):
        luma = _blocks(_luma(photos.part(k, slice(top, top + step), slice(None))), block)
        coarse.append(_blocks(luma, COARSE))
        fine.add(_laplacian(np.concatenate([before, luma])))
        before = luma[-2:]
        yield
    every = slice(None, None, -(-max(width, height) // EXPOSED))
    exposure = _exposure(photos.part(k, every, every), ground)
    yield
    rough = _Variance()
    rough.add(_laplacian(np.concatenate(coarse)))
    known = rough.value > BLANK
    return Measure(float(np.sqrt(fine.value / rough.value)) if known else float("nan"), *exposure)


def thumbnail(photos: Photos, k: int) -> bytes:
    """Return photo k as a small WebP file, its longer side at most THUMBNAIL pixels."""
    image = Image.fromarray(photos.small(k, 3 * THUMBNAIL)[..., :3])
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    file = io.BytesIO()
    image.save(file, "WEBP", quality=QUALITY)
    return file.getvalue()


class _Variance:
    """The variance of numbers that come in parts."""

    def __init__(self) -> None:
        self._count, self._sum, self._squares = 0, 0.0, 0.0

    def add(self, values: np.ndarray) -> None:
        self._count += values.size
        self._sum += float(values.sum(dtype=np.float64))
        self._squares += float((values * values).sum(dtype=np.float64))

    @property
    def value(self) -> float:
        if not self._count:
            return 0.0
        return max(self._squares / self._count - (self._sum / self._count) ** 2, 0.0)


def _luma(pixels: np.ndarray) -> np.ndarray:
    return pixels @ (LUMA / np.float32(65535))


def _blocks(values: np.ndarray, n: int) -> np.ndarray:
    """Means over blocks of n × n; what fills none is dropped."""
    if n == 1:
        return values
    high, wide = values.shape[0] // n, values.shape[1] // n
    return values[: high * n, : wide * n].reshape(high, n, wide, n).mean((1, 3))


def _laplacian(y: np.ndarray) -> np.ndarray:
    if min(y.shape) < 3:
        return np.empty((0, 0), np.float32)
    return y[:-2, 1:-1] + y[2:, 1:-1] + y[1:-1, :-2] + y[1:-1, 2:] - 4 * y[1:-1, 1:-1]


def _exposure(pixels: np.ndarray, ground: tuple[float, float, float] | None) -> tuple[float, float, float]:
    """Mean log2 luminance, and the shares of clipped highlights and shadows."""
    levels = (pixels >> 8).reshape(-1, 3)
    if ground is not None:
        levels = levels[(levels != np.round(255 * np.array(ground)).astype(levels.dtype)).any(1)]
    if not len(levels):
        return float("nan"), 0.0, 0.0
    luminance = _LINEAR[levels] @ LUMA
    stops = float(np.log2(np.maximum(luminance, LEAST_LUMINANCE)).mean())
    return stops, float((levels >= WHITE).any(1).mean()), float((levels <= BLACK).all(1).mean())


def _linear() -> np.ndarray:
    """The linear value of each 8-bit level of sRGB."""
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _linear()
