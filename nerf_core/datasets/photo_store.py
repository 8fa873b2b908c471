"""Where the pixels of a large capture lie: in a file of the cache that is mapped into memory, or in memory.

The file `pixels` has the photos one after the other, and `there` a byte for each photo: 1 if all its pixels are on the
disk. A photo is marked only after its pixels were flushed, so neither a killed process nor a power cut leaves a photo
that is there in name only. Two processes that fill one entry write the same bytes to the same places.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import PIL

from nerf_core.common import cache
from nerf_core.common.language import phrase
from nerf_core.common.text import size as in_bytes

FORMAT = 1  # of the files, and of how photos are read: EXIF, profiles, averaging
SPARE_BYTES = 1e9  # of the disk that stay free
FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)  # neither is everywhere
FLUSH = 64  # photos between two flushes: so many are read again if the process is killed


def store_key(files: Sequence[Path], how: Sequence[Any]) -> str:
    """Return what the pixels depend on, as a name.

    Args:
        files: the photos; their places, sizes and times of change count.
        how: what else they depend on, as JSON values.
    """
    homes = {folder: os.path.realpath(folder) for folder in {f.parent for f in files}}
    found = [(homes[f.parent], f.name, (s := f.stat()).st_size, s.st_mtime_ns) for f in files]
    text = json.dumps([FORMAT, PIL.__version__, found, how])
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


class Store:
    """The pixels of N photos. Threads may write different photos at once.

    flat: (P, 3) all pixels.
    there: (N,) bool, which photos were there when it was opened.
    note: why the pixels lie in memory; empty: they lie in the cache.
    """

    def __init__(self, flat: np.ndarray, there: np.ndarray, note: str = "") -> None:
        self.flat, self.there, self.note = flat, there, note

    def write(self, start: int, pixels: np.ndarray) -> None:
        """Write the pixels (n, 3) of a photo, whose first is number `start`. Raises OSError."""
        self.flat[start : start + len(pixels)] = pixels

    def mark(self, photos: Sequence[int]) -> None:
        """Note that photos were written. Raises OSError."""

    @staticmethod
    def open(key: str, name: str, rows: int, count: int, dtype: np.dtype) -> Store:
        """Open the entry of the cache, or make it; where that is impossible, the pixels lie in memory.

        Args:
            key: of `store_key`.
            name: of the capture.
            rows, count: the numbers of pixels and of photos.
            dtype: of a channel.
        """
        folder, wanted = cache.entry_folder("photos", key, name), 3 * rows * dtype.itemsize
        new = not folder.exists()
        try:
            if wanted > cache.MOST_BYTES:
                raise OSError(f"{in_bytes(wanted)} are more than the cache holds, {in_bytes(cache.MOST_BYTES)}")
            cache.make_room(wanted, folder)
            folder.mkdir(parents=True, exist_ok=True)
            cache.used(folder)
            return _Mapped(folder, (rows, 3), count, dtype)
        except OSError as error:
            if new:
                shutil.rmtree(folder.parent, ignore_errors=True)
            note = phrase("the photos lie in memory and not in the cache, {folder}: {reason}",
                          folder=str(folder), reason=error.strerror or str(error))  # fmt: skip
            return Store(np.empty((rows, 3), dtype), np.zeros(count, bool), note)


class _Mapped(Store):
    """Pixels in a file. They are written past the mapping: pages that nobody has read take no memory of this process.

    Raises OSError if the files cannot be made, or the disk has too little space for them.
    """

    def __init__(self, folder: Path, shape: tuple[int, int], count: int, dtype: np.dtype) -> None:
        length = shape[0] * shape[1] * dtype.itemsize
        self._marks = self._pixels = -1
        self._writing = threading.Lock()  # os.pwrite, which needs none, is not there on Windows
        try:
            self._marks = os.open(folder / "there", FLAGS, 0o644)
            self._pixels = os.open(folder / "pixels", FLAGS, 0o644)
            if os.fstat(self._pixels).st_size < length:  # marks of pixels that another process deleted, or never wrote
                os.ftruncate(self._marks, 0)
            _reserve(self._pixels, length, folder)
            _reserve(self._marks, count, folder)
            mapped = mmap.mmap(self._pixels, length)
        except BaseException:
            self._close()
            raise
        flat = np.frombuffer(mapped, dtype).reshape(shape)
        os.lseek(self._marks, 0, os.SEEK_SET)
        marks = np.frombuffer(os.read(self._marks, count), np.uint8)
        super().__init__(flat, marks == 1)

    def write(self, start: int, pixels: np.ndarray) -> None:
        rest = memoryview(np.ascontiguousarray(pixels, self.flat.dtype).tobytes())
        with self._writing:
            os.lseek(self._pixels, start * 3 * self.flat.itemsize, os.SEEK_SET)
            while rest:
                rest = rest[os.write(self._pixels, rest) :]

    def mark(self, photos: Sequence[int]) -> None:
        os.fsync(self._pixels)
        with self._writing:
            for k in photos:
                os.lseek(self._marks, k, os.SEEK_SET)
                os.write(self._marks, b"\1")

    def _close(self) -> None:
        for descriptor in (self._marks, self._pixels):
            if descriptor >= 0:
                os.close(descriptor)
        self._marks = self._pixels = -1

    def __del__(self) -> None:
        if hasattr(self, "_pixels"):
            self._close()


def _reserve(descriptor: int, length: int, folder: Path) -> None:
    """Give a file its length, with space on the disk: writing to a mapped file on a full disk ends the process."""
    lacking = length - os.fstat(descriptor).st_size
    if lacking <= 0:
        return
    if shutil.disk_usage(folder).free < lacking + SPARE_BYTES:
        raise OSError(f"its disk has no space for {in_bytes(lacking)}")
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, length)
    else:
        os.ftruncate(descriptor, length)
