"""Keep the pixels of all photos in one array, so that a training batch can mix pixels of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Photos:
    """N photos of any size.

    flat: (P, 3) uint16, the pixels row by row; it may also hold pixels of other photos.
    starts: (N,) int64, the row of `flat` at which each photo begins.
    sizes: (N, 2) int64, width and height.
    """

    flat: np.ndarray
    starts: np.ndarray
    sizes: np.ndarray

    @staticmethod
    def empty(sizes: Sequence[tuple[int, int]]) -> Photos:
        """Allocate photos of these sizes (width, height); the caller fills them through `images`."""
        table = np.array(sizes, np.int64).reshape(-1, 2)
        ends = np.cumsum(table.prod(1))
        return Photos(np.empty((table.prod(1).sum(), 3), np.uint16), ends - table.prod(1), table)

    @staticmethod
    def of(images: Sequence[np.ndarray]) -> Photos:
        """Copy uint16 images (H, W, 3)."""
        photos = Photos.empty([(image.shape[1], image.shape[0]) for image in images])
        for room, image in zip(photos.images, images, strict=True):
            room[:] = image
        return photos

    @cached_property
    def images(self) -> tuple[np.ndarray, ...]:
        """The photos as views (H, W, 3) into `flat`."""
        places = zip(self.starts.tolist(), self.sizes.tolist(), strict=True)
        return tuple(self.flat[start : start + w * h].reshape(h, w, 3) for start, (w, h) in places)

    def at(self, index: Sequence[int]) -> Photos:
        """Return the photos of these indices without a copy."""
        chosen = np.array(index, np.int64)
        return Photos(self.flat, self.starts[chosen], self.sizes[chosen])
