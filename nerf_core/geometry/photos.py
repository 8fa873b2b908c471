"""Keep the pixels of all photos in one array, so that a training batch can mix pixels of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, overload

import numpy as np

DIMMED = 4  # how many times darker masked pixels are shown
WIDEN = 257  # 255 · 257 = 65535: the 16-bit value of an 8-bit one


@dataclass(frozen=True, eq=False)
class Photos:
    """N photos of any size, whose pixels read as uint16, 65535 = 1.

    flat: (P, 3) the pixels row by row; it may also hold pixels of other photos. uint16, or uint8 if each pixel is the
        one of an 8-bit photo: half the memory, the same colours.
    starts: (N,) int64, the row of `flat` at which each photo begins.
    sizes: (N, 2) int64, width and height.
    kept: (P,) bool, False for pixels that are masked: they are neither trained on nor measured. None: all count.
    """

    flat: np.ndarray
    starts: np.ndarray
    sizes: np.ndarray
    kept: np.ndarray | None = None

    @staticmethod
    def empty(sizes: Sequence[tuple[int, int]], eight_bits: bool = False) -> Photos:
        """Allocate photos of these sizes (width, height); the caller fills them with `put`."""
        table = np.array(sizes, np.int64).reshape(-1, 2)
        ends = np.cumsum(table.prod(1))
        flat = np.empty((table.prod(1).sum(), 3), np.uint8 if eight_bits else np.uint16)
        return Photos(flat, ends - table.prod(1), table)

    @staticmethod
    def of(images: Sequence[np.ndarray]) -> Photos:
        """Copy uint16 images (H, W, 3)."""
        photos = Photos.empty([(image.shape[1], image.shape[0]) for image in images])
        for k, image in enumerate(images):
            photos.put(k, image)
        return photos

    def put(self, k: int, image: np.ndarray) -> None:
        """Write photo k, uint16 (H, W, 3). Where 8 bits are kept, the values must be those of an 8-bit photo."""
        self._stored[k][:] = image if self.flat.dtype == np.uint16 else image // WIDEN

    @property
    def images(self) -> Sequence[np.ndarray]:
        """The photos, uint16 (H, W, 3): views into `flat`, or copies made at each access if that has 8 bits."""
        return self._stored if self.flat.dtype == np.uint16 else _Widened(self)

    def part(self, k: int, rows: Any, columns: Any) -> np.ndarray:
        """Return image[rows, columns] of photo k, uint16, for any indices or slices of numpy."""
        found = self._stored[k][rows, columns]
        return found if found.dtype == np.uint16 else found.astype(np.uint16) * np.uint16(WIDEN)

    def masked(self, masks: Mapping[int, np.ndarray]) -> Photos:
        """Return the photos with masks by photo, (H, W) bool; photos without one are used whole."""
        kept = np.ones(len(self.flat), bool)
        for k, mask in masks.items():
            kept[self.starts[k] : self.starts[k] + mask.size] = mask.ravel()
        return replace(self, kept=kept)

    def mask(self, k: int) -> np.ndarray | None:
        """Return which pixels of photo k count, (H, W) bool; None if all do."""
        width, height = self.sizes[k].tolist()
        found = None if self.kept is None else self.kept[self.starts[k] : self.starts[k] + width * height]
        return None if found is None or found.all() else found.reshape(height, width)

    def counts(self, k: int, x: int, y: int) -> bool:
        """Return whether the pixel of column x and row y of photo k counts."""
        return self.kept is None or bool(self.kept[self.starts[k] + y * self.sizes[k, 0] + x])

    @cached_property
    def masked_photos(self) -> tuple[int, ...]:
        """The photos of which some pixels do not count."""
        return tuple(k for k in range(len(self.sizes)) if self.mask(k) is not None)

    def small(self, k: int, most: int) -> np.ndarray:
        """Return every n-th pixel of photo k as opaque uint8 RGBA, its sides about `most` long at most.

        Masked pixels are dimmed.
        """
        every = slice(None, None, max(1, -(-int(self.sizes[k].max()) // most)))
        rgb = (self.part(k, every, every) >> 8).astype(np.uint8)
        if (mask := self.mask(k)) is not None:
            rgb = np.where(mask[every, every, None], rgb, rgb // DIMMED)
        return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])

    def at(self, index: Sequence[int]) -> Photos:
        """Return the photos of these indices without a copy."""
        chosen = np.array(index, np.int64)
        return Photos(self.flat, self.starts[chosen], self.sizes[chosen], self.kept)

    @cached_property
    def _stored(self) -> tuple[np.ndarray, ...]:
        places = zip(self.starts.tolist(), self.sizes.tolist(), strict=True)
        return tuple(self.flat[start : start + w * h].reshape(h, w, 3) for start, (w, h) in places)


class _Widened(Sequence[np.ndarray]):
    """8-bit photos as a sequence of uint16 images, each made when it is asked for."""

    def __init__(self, photos: Photos) -> None:
        self._photos = photos

    def __len__(self) -> int:
        return len(self._photos.sizes)

    @overload
    def __getitem__(self, k: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, k: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, k: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        if isinstance(k, slice):
            return [self[i] for i in range(len(self))[k]]
        return self._photos.part(k, slice(None), slice(None))
