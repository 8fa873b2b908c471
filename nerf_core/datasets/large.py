"""Open a capture that takes long to decode: its first photos now, the rest in the background into the cache.

Which photos a training step draws from follows the step and never the clock (`training/batches.py`), so that the same
seed gives the same weights however fast the photos arrive, and also when all lie in the cache already.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.language import phrase
from nerf_core.common.memory import free_memory
from nerf_core.common.text import duration
from nerf_core.common.text import size as in_bytes
from nerf_core.datasets.arriving import Arriving
from nerf_core.datasets.capture import Capture
from nerf_core.datasets.images import Header, UnreadableError, read_photo
from nerf_core.datasets.in_threads import THREADS, Progress, in_threads
from nerf_core.datasets.photo_store import Store, store_key
from nerf_core.geometry.photos import THERE, WAITING, WIDEN, Photos, first_photos

LARGE_PIXELS = 4e9  # of all files: over a minute of decoding on two cores, 330 photos of 12 megapixels
MEMORY_SHARE = 0.5  # of the free memory that photos may take: the model, and what else is open, need the rest
LONG = 120.0  # seconds of reading from which a smaller size is looked at
FASTER = 0.7  # of the time that a smaller size must save to be worth a word


@dataclass(frozen=True)
class Reading:
    """How the N photos of a capture are read.

    name: of the capture's folder.
    capture: its cameras have the sizes that are wanted.
    headers: of the files.
    upright: which photos are turned by EXIF.
    eight_bits: whether 8 bits hold them.
    background: the sRGB colour behind transparent pixels.
    """

    name: str
    capture: Capture
    headers: Sequence[Header]
    upright: Sequence[bool]
    eight_bits: bool
    background: tuple[float, float, float]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Return the sizes (width, height) that are wanted."""
        return [(photo.camera.width, photo.camera.height) for photo in self.capture.photos]

    def pixels(self, k: int, divisor: int = 1) -> np.ndarray:
        """Read photo k at 1/divisor of its size: (n, 3) uint8 or uint16. Raises UnreadableError."""
        photo = self.capture.photos[k]
        size = max(1, photo.camera.width // divisor), max(1, photo.camera.height // divisor)
        image = read_photo(photo.path, size, self.background, self.upright[k], fast=True)
        return (image // WIDEN if self.eight_bits else image).reshape(-1, 3)


def is_large(capture: Capture, headers: Sequence[Header], by_alpha: bool) -> bool:
    """Return whether photos are read in the background. Those with masks are not: masks are needed from the first step.

    by_alpha: whether alpha is a mask.
    """
    if any(p.mask is not None for p in capture.photos) or (by_alpha and any(h.alpha for h in headers)):
        return False
    return sum(h.width * h.height for h in headers) > LARGE_PIXELS


def arriving(how: Reading, progress: Progress | None) -> tuple[Photos, list[str]]:
    """Read the first photos and begin to read the others.

    Args:
        how: the photos.
        progress: called as (what is done, photos done, photos in all); it may raise to cancel.

    Returns:
        The photos, and notes: how long it takes, and which size suits the machine.

    Raises:
        UserError: none of the first photos can be read.
    """
    sizes = np.array(how.sizes, np.int64)
    counts = sizes.prod(1)
    starts, rows = np.cumsum(counts) - counts, int(counts.sum())
    dtype = np.dtype(np.uint8 if how.eight_bits else np.uint16)
    files = [photo.path for photo in how.capture.photos]
    key = store_key(files, [sizes.tolist(), list(map(bool, how.upright)), how.eight_bits, how.background])
    store = Store.open(key, how.name, rows, len(files), dtype)
    order = spread_order(len(files), how.capture.named_splits().get("train", ()))
    filling = Arriving(how.pixels, starts, order, np.array([f.stat().st_size for f in files], np.int64), store)
    first = order[: first_photos(0)]
    new, begun = int((filling.state[first] == WAITING).sum()), time.monotonic()
    in_threads(lambda i: filling.need(int(first[i])), range(len(first)), phrase("reading the first photos"), progress)
    if not (filling.state[first] == THERE).any():
        raise UserError(f"no photo can be read ({filling.damaged()[0]}): save them as PNG or JPEG")
    each = (time.monotonic() - begun) / new if new else 0.0
    filling.start(THREADS)
    left = each * int((filling.state == WAITING).sum())
    notes = [_said(how, store, left), _proposal(how, store, int(first[0]), left)]
    return Photos(store.flat, starts, sizes, None, filling, np.arange(len(files))), list(filter(None, notes))


def spread_order(count: int, train: Sequence[int]) -> np.ndarray:
    """Return an order (count,) int64 of photos: those of `train` first, of which every beginning is spread evenly.

    Numbers are sorted by their bits read backwards (van der Corput's sequence).
    """
    bits = max(1, (len(train) - 1).bit_length())
    backwards = [int(format(i, f"0{bits}b")[::-1], 2) for i in range(1 << bits)]
    chosen = [train[i] for i in backwards if i < len(train)]
    others = np.setdiff1d(np.arange(count), np.array(chosen, np.int64))
    return np.concatenate([np.array(chosen, np.int64), others])


def _said(how: Reading, store: Store, left: float) -> str:
    """What is read, where it lies and how long it takes."""
    count, (width, height) = len(how.sizes), how.sizes[0]
    place = store.note or phrase("they lie in the cache (`nerf-core cache` lists it)")
    if not left:
        return phrase(
            "{count:,} photos at {width}×{height} take {bytes}: {place}",
            count=count, width=width, height=height, bytes=in_bytes(store.flat.nbytes), place=place,
        )  # fmt: skip
    return phrase(
        "{count:,} photos are read in the background at {width}×{height}, in about {time}; training begins with "
        "{first}. They take {bytes}: {place}",
        count=count, width=width, height=height, time=duration(left), first=min(count, first_photos(0)),
        bytes=in_bytes(store.flat.nbytes), place=place,
    )  # fmt: skip


def _proposal(how: Reading, store: Store, k: int, left: float) -> str:
    """The downscale that suits the machine, if the photos take too much memory or time; empty: this one does.

    k: a photo that can be timed. left: the seconds that reading takes.
    """
    free = free_memory()
    divisor = math.ceil(math.sqrt(store.flat.nbytes / (MEMORY_SHARE * free)))
    if divisor <= 1 and left < LONG:
        return ""
    try:
        now, then = _seconds(how, k, 1), _seconds(how, k, smaller := max(2, divisor))
    except UnreadableError:
        return ""
    if divisor <= 1 and then > FASTER * now:
        return ""
    seconds = left * then / now if left else then / THREADS * len(how.sizes)
    header, (width, height) = how.headers[k], how.sizes[k]
    ratio = how.capture.reduced * max(header.width, header.height) / max(width, height)
    why = phrase("{free} of memory are free", free=in_bytes(free)) if divisor > 1 else phrase("it is faster")
    return phrase(
        "--downscale {downscale} suits this machine better ({why}): {width}×{height}, {bytes}, read in about {time}",
        downscale=math.ceil(smaller * ratio), why=why, width=width // smaller, height=height // smaller,
        bytes=in_bytes(store.flat.nbytes / smaller**2), time=duration(seconds),
    )  # fmt: skip


def _seconds(how: Reading, k: int, divisor: int) -> float:
    begun = time.perf_counter()
    how.pixels(k, divisor)
    return time.perf_counter() - begun
