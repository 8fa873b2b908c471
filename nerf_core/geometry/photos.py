"""Keep the pixels of all photos in one array, so that a training batch can mix pixels of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, overload

import numpy as np

from nerf_core.common.errors import UserError

DIMMED = 4  # how many times darker masked pixels are shown
WIDEN = 257  # 255 · 257 = 65535: the 16-bit value of an 8-bit one
WAITING, THERE, DAMAGED = range(3)  # the states of a photo that is read while others are used already

FIRST_PHOTOS = 100  # that training begins with: some seconds of decoding, and all sides of most captures
PHOTOS_A_STEP = 2  # that each step adds: two cores decode about as many as they train steps


def first_photos(step: int) -> int:
    """Return how many photos of a large capture a training step may draw from, in `Filling.order`.

    It follows the step alone. A step waits until they are read, so that the clock decides nothing.
    """
    return FIRST_PHOTOS + PHOTOS_A_STEP * step


class PhotosLost(UserError):
    """The photos of a large capture cannot be read any more."""


class Filling(Protocol):
    """Reads the N photos of a large capture while those that are there are used. Threads may share it.

    order: (N,) int64, in which order they are read: early ones are spread over the whole capture.
    state: (N,) uint8, WAITING, THERE or DAMAGED for each.
    bytes: (N,) int64, the sizes of their files.
    """

    order: np.ndarray
    state: np.ndarray
    bytes: np.ndarray

    def need(self, k: int) -> None:
        """Read photo k now, unless that is done. Raises PhotosLost if reading had to end."""
        ...

    def prefer(self, k: int) -> None:
        """Let photo k be read before the others."""
        ...

    def check(self) -> None:
        """Raises PhotosLost if reading had to end."""
        ...

    def seconds_left(self) -> float | None:
        """Return how long reading the rest takes; None: not known yet."""
        ...

    def damaged(self) -> tuple[str, ...]:
        """Return what is wrong with each photo that could not be read."""
        ...


@dataclass(frozen=True, eq=False)
class Photos:
    """N photos of any size, whose pixels read as uint16, 65535 = 1.

    flat: (P, 3) the pixels row by row; it may also hold pixels of other photos. uint16, or uint8 if each pixel is the
        one of an 8-bit photo: half the memory, the same colours.
    starts: (N,) int64, the row of `flat` at which each photo begins.
    sizes: (N, 2) int64, width and height.
    kept: (P,) bool, False for pixels that are masked: they are neither trained on nor measured. None: all count.
    filling: reads the photos of a large capture, which then have no masks; None: all are there. A photo is read at the
        latest when its pixels are asked for. A damaged one is black, and none of its pixels counts.
    ids: (N,) int64, the photos' numbers in `filling`.
    """

    flat: np.ndarray
    starts: np.ndarray
    sizes: np.ndarray
    kept: np.ndarray | None = None
    filling: Filling | None = None
    ids: np.ndarray | None = None

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
        """The photos, uint16 (H, W, 3): views into `flat`, or made at each access if it has 8 bits or they are read."""
        return self._stored if self.flat.dtype == np.uint16 and self.filling is None else _Widened(self)

    def part(self, k: int, rows: Any, columns: Any) -> np.ndarray:
        """Return image[rows, columns] of photo k, uint16, for any indices or slices of numpy.

        A photo that is not there yet is read now, which may take a quarter of a second; see `there`.
        """
        if self.filling is not None and self.ids is not None:
            self.filling.need(int(self.ids[k]))
        found = self._stored[k][rows, columns]
        return found if found.dtype == np.uint16 else found.astype(np.uint16) * np.uint16(WIDEN)

    def there(self, k: int) -> bool:
        """Return whether the pixels of photo k can be had at once. If not, it is read next."""
        if self.filling is None or self.ids is None:
            return True
        found = self.filling.state[self.ids[k]] != WAITING
        if not found:
            self.filling.prefer(int(self.ids[k]))
        return bool(found)

    def damaged(self, k: int) -> bool:
        """Return whether photo k was found to be damaged when it was read."""
        return self.filling is not None and self.ids is not None and self.filling.state[self.ids[k]] == DAMAGED

    def reading(self) -> tuple[int, int, float | None] | None:
        """Return how many photos are read, of how many, and the seconds for the rest (None: not known yet).

        None: all are.
        """
        if self.filling is None:
            return None
        done, total = int(np.count_nonzero(self.filling.state)), len(self.filling.state)
        return None if done == total else (done, total, self.filling.seconds_left())

    def present(self) -> np.ndarray:
        """Return which photos have pixels now, (N,) bool: not damaged ones, nor those that are still to be read."""
        if self.filling is None or self.ids is None:
            return np.ones(len(self.sizes), bool)
        return self.filling.state[self.ids] == THERE

    def masked(self, masks: Mapping[int, np.ndarray]) -> Photos:
        """Return the photos with masks by photo, (H, W) bool; photos without one are used whole."""
        kept = np.ones(len(self.flat), bool)
        for k, mask in masks.items():
            kept[self.starts[k] : self.starts[k] + mask.size] = mask.ravel()
        return replace(self, kept=kept)

    def mask(self, k: int) -> np.ndarray | None:
        """Return which pixels of photo k count, (H, W) bool; None if all do."""
        width, height = self.sizes[k].tolist()
        if self.damaged(k):
            return np.zeros((height, width), bool)
        found = None if self.kept is None else self.kept[self.starts[k] : self.starts[k] + width * height]
        return None if found is None or found.all() else found.reshape(height, width)

    def counts(self, k: int, x: int, y: int) -> bool:
        """Return whether the pixel of column x and row y of photo k counts."""
        if self.kept is None:
            return not self.damaged(k)
        return bool(self.kept[self.starts[k] + y * self.sizes[k, 0] + x])

    def counting(self, index: Sequence[int]) -> int:
        """Return how many pixels of the photos `index` are not masked. Damaged photos have theirs, too."""
        many = self.sizes.prod(1)
        if self.kept is None:
            return int(many[list(index)].sum())
        return sum(int(np.count_nonzero(self.kept[self.starts[k] : self.starts[k] + many[k]])) for k in index)

    @cached_property
    def masked_photos(self) -> tuple[int, ...]:
        """The photos of which some pixels do not count."""
        return () if self.kept is None else tuple(k for k in range(len(self.sizes)) if self.mask(k) is not None)

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
        ids = None if self.ids is None else self.ids[chosen]
        return Photos(self.flat, self.starts[chosen], self.sizes[chosen], self.kept, self.filling, ids)

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
