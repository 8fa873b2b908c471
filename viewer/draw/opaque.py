"""Pictures without transparency, for textures, which have it."""

from __future__ import annotations

import numpy as np


class OpaquePictures:
    """Makes RGBA of RGB, once for each array: a texture is uploaded again only if it is another array object."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def rgba(self, key: str, rgb: np.ndarray) -> np.ndarray:
        """Return (h, w, 4) uint8 of (h, w, 3) uint8; the same array as long as `rgb` of this key is the same."""
        known = self._known.get(key)
        if known is None or known[0] is not rgb:
            known = self._known[key] = rgb, np.concatenate([rgb, np.full((*rgb.shape[:2], 1), 255, np.uint8)], -1)
        return known[1]
