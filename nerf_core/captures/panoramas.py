"""Recognise equirectangular panoramas, whose poses are not searched for."""

from __future__ import annotations

import numpy as np

SEAM = 2.0  # times the usual difference of neighbouring columns: a panorama's ends are neighbours
POLE = 0.25  # of the spread in the picture's middle: the first and the last row are one direction each
PLAIN = 8.0  # levels of 255: a column with less spread is plain, and says nothing of the seam
ROUNDING = 1.0  # level: differences below it are those of the encoding


def is_panorama(pixels: np.ndarray) -> bool:
    """Return whether a picture (H, W, 3), in levels of 0 … 255, shows all around: twice as wide as high, and closed.

    Its ends fit together, and each pole fills a row.
    """
    high, wide = pixels.shape[:2]
    if wide != 2 * high or high < 16:
        return False
    grey = pixels.astype(np.float32).mean(2)
    if grey[:, 0].std() < PLAIN:
        return False
    usual = float(np.median(np.abs(np.diff(grey, axis=1)).mean(0)))
    seam = float(np.abs(grey[:, 0] - grey[:, -1]).mean())
    middle = float(grey[high // 4 : -(high // 4)].std(1).mean())
    poles = max(float(grey[0].std()), float(grey[-1].std()))
    return seam <= SEAM * usual + ROUNDING and poles <= POLE * middle + ROUNDING
