"""What readers of posed photos share: numbers in texts, rotations, and the photos that a file lists by name."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.json_files import LIMIT, MAX_BYTES, STRETCH
from nerf_core.common.language import phrases
from nerf_core.datasets.capture import Photo
from nerf_core.datasets.images import UnreadableError, damage_notes
from nerf_core.datasets.photo_paths import find_photos, photo_name
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import PINHOLE, Lens

NARROWEST = 1e-4  # smallest focal length in image widths: with less the field of view is practically 180°
AGAIN = "export it again"


@dataclass(frozen=True)
class Posed:
    """One entry of a file that lists posed photos.

    listed: the photo's path relative to the folder, with or without extension.
    camera: makes its camera, given the photo's file. It may raise UnreadableError for a damaged photo.
    """

    listed: str
    camera: Callable[[Path], Camera]


def posed_photos(folder: Path, source: Path, entries: Sequence[Posed]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Find the photos of all entries below `folder`, and return them with their cameras, and notes.

    Missing, damaged and repeated photos are noted. Raises UserError if none is left.
    """
    found = find_photos(folder, [entry.listed for entry in entries], source)
    photos: dict[str, Photo] = {}
    damaged: list[str] = []
    doubles: list[str] = []
    for entry, path in zip(entries, found.paths, strict=True):
        if path is None:
            continue
        key = os.path.abspath(path)
        if key in photos:
            doubles.append(photos[key].name)
            continue
        try:
            photos[key] = Photo(photo_name(folder, path), path, entry.camera(path))
        except UnreadableError as error:
            damaged.append(str(error))
    if not photos:
        raise UserError(f"{source}: no listed photo can be read ({damaged[0]}): save them as PNG or JPEG")
    notes = [*found.notes, *damage_notes(damaged)]
    if doubles:
        notes.append(
            phrases(
                "{file}: {n:,} photo listed more than once (first {first}); the first pose holds",
                "{file}: {n:,} photos listed more than once (first {first}); the first pose holds",
                len(doubles),
                file=source,
                first=doubles[0],
            )
        )
    return tuple(photos.values()), tuple(notes)


def photo_home(root: Path) -> Path:
    """Return where a program's export has its photos: in the folder images, or beside the file."""
    return root / "images" if (root / "images").is_dir() else root


def checked_camera(
    where: str, size: tuple[int, int], focal: tuple[float, float], center: tuple[float, float], c2w: np.ndarray,
    lens: Lens = PINHOLE,
) -> Camera:  # fmt: skip
    """Return a camera if its focal lengths are possible. Raises UserError.

    Args:
        where: file and entry, for the message.
        size: width and height in pixels.
        focal: fx and fy in pixels.
        center: cx and cy in pixels.
        c2w: (3, 4) camera to world, OpenGL axes.
        lens: the lens.
    """
    if min(focal) < NARROWEST * size[0]:
        raise UserError(
            f"{where} has the focal length {min(focal):g} in pixels of a photo of {size[0]}: no lens sees that wide, "
            f"{AGAIN}"
        )
    return Camera(*size, *focal, *center, c2w, lens)


def number_of(text: str | None, where: str) -> float:
    """Parse a number between ±LIMIT. Raises UserError that says where it is."""
    try:
        value = float(text) if text is not None and len(text) < 100 and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not abs(value) <= LIMIT:
        raise UserError(f"{where} is {shorten(text)}: a number between ±{LIMIT:g} is needed")
    return value


def numbers_of(text: str | None, count: int, where: str) -> np.ndarray:
    """Parse so many numbers, divided by white space. Raises UserError that says where they are."""
    parts = (text or "").split(maxsplit=count)
    if len(parts) != count:
        raise UserError(f"{where} is {shorten(text)}: {count} numbers are needed")
    return np.array([number_of(part, where) for part in parts])


def rotation_of(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a matrix of axes. Raises UserError for sheared and mirrored ones."""
    u, lengths, vt = np.linalg.svd(matrix)
    rotation = u @ vt
    if lengths[2] <= 1e-6 * lengths[0] or lengths[0] > STRETCH * lengths[2] or np.linalg.det(rotation) < 0:
        raise UserError(f"{where} has axes that are sheared, singular or mirrored: a rotation is needed, {AGAIN}")
    return rotation


def quaternion_rotation(quaternion: np.ndarray, where: str) -> np.ndarray:
    """Return the rotation (3, 3) of a quaternion (x, y, z, w), whose length does not count. Raises UserError for 0."""
    length = float(np.linalg.norm(quaternion))
    if not length > 1e-9:
        raise UserError(f"{where} is a quaternion of length {length:g}: a rotation is needed, {AGAIN}")
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_small(file: Path) -> bytes:
    """Read a text file of a calibration. Raises UserError for devices, and for files that are empty or too large."""
    if not file.is_file():
        raise UserError(f"{file} is not a regular file: name an existing file")
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise UserError(f"{file} has {size:,} bytes: no calibration is that large, is it the right file?")
    data = file.read_bytes()
    if not data.strip():
        raise UserError(f"{file} is empty: {AGAIN}")
    return data


def begins_with(file: Path, *words: bytes) -> bool:
    """Return whether the first bytes of a file hold all these words. It never raises."""
    try:
        if not file.is_file():
            return False
        with file.open("rb") as stream:
            head = stream.read(4096)
    except OSError:
        return False
    return all(word in head for word in words)


def chosen_file(path: Path, suffix: str, preferred: str, words: tuple[bytes, ...]) -> Path | None:
    """Return the file of a format: `path` itself, or the one in its folder that begins with all `words`; else None.

    Of several, the one named `preferred` is taken, else the first by name.
    """
    if not path.is_dir():
        return path if path.suffix.lower() == suffix and begins_with(path, *words) else None
    try:
        files = sorted(f for f in path.iterdir() if f.suffix.lower() == suffix and begins_with(f, *words))
    except OSError:
        return None
    return next((f for f in files if f.name == preferred), files[0] if files else None)
