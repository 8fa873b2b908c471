"""Numbers as colours: viridis for scalars, inferno for errors, and a map with two arms for what has a sign.

Stops of matplotlib's maps of those names (CC0), the last its PuOr reversed; between two, a straight line in sRGB.
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
    """Values (…) → colours (…, 3) float32: `low` is the map's beginning, `high` its end; NaN is black."""
    table = _TABLES[name]
    at = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-30), 0, 1) * (len(table) - 1)
    where = np.nan_to_num(at)
    rgb = np.stack([np.interp(where, np.arange(len(table)), table[:, c]) for c in range(3)], -1)
    return np.where(np.isnan(at)[..., None], 0, rgb).astype(np.float32)
