"""Which frequencies a picture has: its Fourier spectrum as a map, and the mean power over the frequency.

Both are of the luminance, under a Hann window. Without a window the step between opposite edges of a picture, which the
Fourier transform takes for neighbours, draws a bright cross over the map and hides the weak high frequencies. The price
is that a pure wave is one bin wider on each side.
"""

from __future__ import annotations

import numpy as np

LUMINANCE = (0.2126, 0.7152, 0.0722)  # of red, green and blue (Rec. 709), of the encoded values
FLOOR = 1e-6  # amplitude: a tenth of what rounding a picture of 128 × 128 to 8 bits puts into each bin
SHOWN = 0.005  # share of the target's bins that are darker than the map's range: single near-zeros say nothing


def luminance(picture: np.ndarray) -> np.ndarray:
    """Return the luminance (H, W) in float64 of a picture (H, W, 3)."""
    return np.asarray(picture, np.float64) @ np.array(LUMINANCE)


def spectrum(picture: np.ndarray) -> np.ndarray:
    """Return the amplitude of each frequency in dB, 20 log₁₀, for a map.

    A wave of amplitude a around the mean has a/2 at its frequency and at the opposite one. The mean itself is removed.

    Args:
        picture: (H, W, 3) in [0, 1].

    Returns:
        (H, W) float32, with frequency 0 at (H // 2, W // 2). Row and column count cycles per height and per width.
    """
    transform, window = _transform(picture)
    amplitude = np.abs(np.fft.fftshift(transform)) / window.sum()
    return (20 * np.log10(np.maximum(amplitude, FLOOR))).astype(np.float32)


def map_range(target: np.ndarray) -> tuple[float, float]:
    """Return the range (low, high) in dB in which the target's `spectrum` and those of all results are drawn."""
    return float(np.quantile(target, SHOWN)), float(target.max())


def radial_profile(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean power of a picture over rings of equal frequency.

    The power of a bin is its share of the luminance's variance: all bins of all rings together hold all of it.

    Args:
        picture: (H, W, 3) in [0, 1].

    Returns:
        frequencies (F,): 1, 2, … in cycles per longest side, up to half its pixels (the Nyquist frequency).
        power (F,): the mean over the bins whose frequency rounds to that number.
    """
    transform, window = _transform(picture)
    height, width = window.shape
    power = np.abs(transform) ** 2 / (window.size * np.square(window).sum())
    side = max(height, width)
    rows, columns = np.fft.fftfreq(height, 1 / side), np.fft.fftfreq(width, 1 / side)
    ring = np.rint(np.hypot(rows[:, None], columns)).astype(np.int64).ravel()
    total, count = np.bincount(ring, power.ravel()), np.bincount(ring)
    frequencies = np.arange(1, side // 2 + 1)
    return frequencies.astype(np.float64), total[frequencies] / count[frequencies]


def _transform(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Fourier transform (H, W) of the windowed luminance without its mean, and the window (H, W)."""
    values = luminance(picture)
    # periodic: a Hann window of N + 1 points without its last one, which the first one repeats
    rows, columns = (np.sin(np.pi * np.arange(count) / count) ** 2 for count in values.shape)
    window = rows[:, None] * columns
    return np.fft.fft2((values - values.mean()) * window), window
