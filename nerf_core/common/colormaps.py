"""Colour maps: viridis for scalars, inferno for errors, and a diverging map for signed values.

Each map is a list of stops taken from matplotlib (CC0); "signed" is matplotlib's PuOr reversed. Colours between two
stops are interpolated linearly in sRGB.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

Name = Literal["viridis", "inferno", "signed"]

STOPS: dict[Name, str] = {
    "viridis": "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c "
    "1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725",
    "inferno": "000004 0b0724 210c4a 3d0965 57106e 71196e 8a226a a32c61 bc3754 "
    "d24644 e45a31 f1731d f98e09 fcac11 f9cb35 f2ea69 fcffa4",
    "signed": "2d004b 451871 5f3a91 7b6aa8 9990bf b7b1d5 cfcfe5 e4e5f0 f7f7f6 "
    "fce8cd fed59f fdbc6b ee9b39 d97b12 bd6109 9e4c07 7f3b08",
}
_TABLES = {name: np.array([list(bytes.fromhex(stop)) for stop in text.split()]) / 255 for name, text in STOPS.items()}


def colored(values: np.ndarray, low: float, high: float, name: Name = "viridis") -> np.ndarray:
    """Map values to colours.

    Args:
        values: numbers of any shape (…).
        low, high: the values that get the first and the last colour; values outside are clamped.
        name: the colour map.

    Returns:
        sRGB colours (…, 3), float32 in [0, 1]. NaN becomes black.
    """
    table = _TABLES[name]
    at = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-30), 0, 1) * (len(table) - 1)
    where = np.nan_to_num(at)
    rgb = np.stack([np.interp(where, np.arange(len(table)), table[:, c]) for c in range(3)], -1)
    return np.where(np.isnan(at)[..., None], 0, rgb).astype(np.float32)
