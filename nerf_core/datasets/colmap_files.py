"""Find COLMAP's model files and check that they are complete.

pycolmap trusts the counts in a file. Some damaged files make it allocate gigabytes and hang, and others it reads as
zeros. So this module checks all counts before pycolmap sees a file. Formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerf_core.common.errors import UserError, shorten

AGAIN = "copy or export the model again"
PARAMETERS = {  # {COLMAP's id of a camera model: number of its parameters}
    0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16, 12: 4, 13: 5, 14: 3, 15: 4, 16: 6,
    17: 2,
}  # fmt: skip
NEEDED = ("cameras", "images", "points3D")
OPTIONAL = ("rigs", "frames")  # since COLMAP 3.12
STATED = re.compile(r"#\s*Number of \w+:\s*(\d+)")
PLACES = ("sparse", "colmap/sparse")


def suffix_of(folder: Path) -> str | None:
    """Return .bin or .txt if `folder` holds a model, else None. Of both, .bin comes first, as in COLMAP."""
    for suffix in (".bin", ".txt"):
        if all((folder / (name + suffix)).is_file() for name in NEEDED):
            return suffix
    return None


def find_models(path: Path) -> list[Path]:
    """Return the folders that hold a capture's models: sparse/0, sparse/1 …, sparse itself, or the folder itself."""
    for place in PLACES:
        base = path / place
        inside = sorted(f for f in base.iterdir() if f.is_dir()) if base.is_dir() else []
        found = [folder for folder in (base, *inside) if suffix_of(folder)]
        if found:
            return found
    return [path] if suffix_of(path) else []


def image_count(folder: Path) -> int:
    """Return the number of images in a model's header; 0 if the header is damaged."""
    file = folder / f"images{suffix_of(folder)}"
    if file.suffix == ".bin":
        with file.open("rb") as stream:
            head = stream.read(8)
        return struct.unpack("<Q", head)[0] if len(head) == 8 else 0
    return sum(1 for _ in _entries(file))


def photo_names(folder: Path) -> dict[int, str]:
    """Return the photo names of a model by image id. Raises UserError for entries that are not images.

    pycolmap cannot read a name that is not UTF-8, and cuts one in a text at its first space.
    """
    file = folder / f"images{suffix_of(folder)}"
    if file.suffix == ".bin":
        with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return {image: name.decode("utf-8", "surrogateescape") for image, name in _named(_Cursor(file, data))}
    fields = [line.split(maxsplit=9) for line in _entries(file)]
    try:
        return {int(field[0]): field[9].strip().decode("utf-8", "surrogateescape") for field in fields}
    except (ValueError, IndexError) as error:
        raise UserError(f"{file} has entries that are not images: {AGAIN}") from error


def check_model(folder: Path) -> None:
    """Raise UserError if a file of the model is cut off, has wrong counts or has an unknown camera model."""
    suffix = suffix_of(folder)
    for name in NEEDED + OPTIONAL:
        file = folder / f"{name}{suffix}"
        if not file.exists() and name in OPTIONAL:
            continue
        if not file.is_file():
            raise UserError(f"{file} is not a regular file: {AGAIN}")
        if suffix == ".txt":
            _check_text(file)
        else:
            _check_binary(file, name)


# ---- text --------------------------------------------------------------------------------------------------------


def _entries(file: Path) -> Iterator[bytes]:
    """The lines of a text file that are entries. In images.txt a second line with points, maybe empty, follows each."""
    points = False
    with file.open("rb") as stream:
        for line in stream:
            if points:
                points = False
            elif line.strip() and not line.lstrip().startswith(b"#"):
                points = file.name == "images.txt"
                yield line


def _check_text(file: Path) -> None:
    with file.open("rb") as stream:
        stated = STATED.search(stream.read(4096).decode("utf-8", "replace"))
    count = sum(1 for _ in _entries(file))
    if stated and stated[1] != str(count):
        raise UserError(f"{file} claims {shorten(stated[0])}, but holds {count}: {AGAIN}")


# ---- binary ------------------------------------------------------------------------------------------------------


@dataclass
class _Cursor:
    """A position in a binary file. A step beyond the file's end raises UserError."""

    file: Path
    data: mmap.mmap
    at: int = 0

    def skip(self, count: int) -> None:
        if count > len(self.data) - self.at:
            raise UserError(f"{self.file} breaks off after {len(self.data):,} bytes: {AGAIN}")
        self.at += count

    def take(self, layout: str) -> tuple[Any, ...]:
        start = self.at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, start)

    def count(self, least: int) -> int:
        """Read the number of entries that follow. Each needs at least `least` bytes."""
        (number,) = self.take("<Q")
        if number * least > len(self.data) - self.at:
            raise UserError(
                f"{self.file} claims {number:,} entries at byte {self.at - 8}, but has no room for them: {AGAIN}"
            )
        return number

    def text(self) -> bytes:
        start = self.at
        end = self.data.find(b"\0", self.at)
        self.skip((end if end >= 0 else len(self.data)) + 1 - self.at)
        return self.data[start:end]


def _check_binary(file: Path, name: str) -> None:
    if not file.stat().st_size:
        raise UserError(f"{file} is empty: {AGAIN}")
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        cursor = _Cursor(file, data)
        WALKS[name](cursor)
        if cursor.at != len(data):
            raise UserError(f"{file} has {len(data) - cursor.at:,} bytes too many for its counts: {AGAIN}")


def _cameras(cursor: _Cursor) -> None:
    for _ in range(cursor.count(24)):
        camera, model, _, _ = cursor.take("<IiQQ")
        if model not in PARAMETERS:
            raise UserError(f"{cursor.file}: camera {camera} has the unknown camera model {model}: {AGAIN}")
        cursor.skip(8 * PARAMETERS[model])


def _images(cursor: _Cursor) -> None:
    for _ in _named(cursor):
        pass


def _named(cursor: _Cursor) -> Iterator[tuple[int, bytes]]:
    """Walk through the images, and yield the id and the name of each."""
    for _ in range(cursor.count(73)):
        (image,) = cursor.take("<I60x")  # then rotation, translation, camera
        name = cursor.text()
        cursor.skip(24 * cursor.count(24))
        yield image, name


def _points(cursor: _Cursor) -> None:
    for _ in range(cursor.count(51)):
        cursor.skip(43)  # id, position, colour, error
        cursor.skip(8 * cursor.count(8))


def _rigs(cursor: _Cursor) -> None:
    for _ in range(cursor.count(8)):
        _, sensors = cursor.take("<II")
        if sensors:
            cursor.skip(8)  # the reference sensor
        for _ in range(sensors - 1):
            *_, has_pose = cursor.take("<iI?")
            cursor.skip(56 if has_pose else 0)


def _frames(cursor: _Cursor) -> None:
    for _ in range(cursor.count(68)):
        cursor.skip(64)  # id, rig, rotation, translation
        (images,) = cursor.take("<I")
        cursor.skip(16 * images)


WALKS = {"cameras": _cameras, "images": _images, "points3D": _points, "rigs": _rigs, "frames": _frames}
