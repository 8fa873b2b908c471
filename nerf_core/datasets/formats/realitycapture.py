"""RealityCapture's export "Internal/External camera parameters": a CSV file beside the photos or a folder images.

Written from nerfstudio's reader. Its makers' article "RealityCapture XMP Camera Math" says that the usual lens model,
Brown3, is a polynomial of three coefficients without tangential distortion. Each row has

    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2

The focal length f is in millimetres of a film 36 mm wide, and px, py are the offset of the principal point from the
centre; both count in the longer side of the photo. Angles are in degrees, and the world's z axis points up:

    R = R_z(−heading) R_x(pitch) R_y(roll)

takes a camera's axes, which are OpenGL's, to the world. At zero angles it looks down, with y to the top of the photo.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions
from nerf_core.datasets.images import measure
from nerf_core.datasets.posed_files import (
    AGAIN,
    Posed,
    checked_camera,
    chosen_file,
    number_of,
    photo_home,
    posed_photos,
    read_small,
)
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import Lens

NUMBERS = ("x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
REFUSED = ("k4", "t1", "t2")  # of lens models whose published description does not fix their order and sign
FILM = 36.0  # mm
WORDS = (b"#name,", b"heading,pitch,roll", b"px,py,k1")
Row = dict[str, float]


@DATASETS.register("realitycapture")
class RealityCapture:
    """The size of a photo is the file's own, as stored, because the export has none."""

    rank: ClassVar[int] = 8
    files: ClassVar[str] = "a .csv of internal/external camera parameters with images"

    @staticmethod
    def matches(path: Path) -> bool:
        return chosen_file(path, ".csv", "cameras.csv", WORDS) is not None

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by name. Raises UserError."""
        file = chosen_file(path, ".csv", "cameras.csv", WORDS)
        if file is None:
            raise UserError(f"{path} has no .csv with internal/external camera parameters: export it there")
        rows = _rows(file)
        entries = [
            Posed(name, lambda photo, where=where, row=row: _camera(photo, row, where))
            for name, where, row in sorted(rows, key=lambda found: found[0])
        ]
        photos, notes = posed_photos(photo_home(file.parent), file, entries)
        return Capture(format="realitycapture", photos=photos, notes=notes)


def _rows(file: Path) -> list[tuple[str, str, Row]]:
    """The name of each row's photo, its place in words, and its numbers. Raises UserError."""
    try:
        text = read_small(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{file} is not text ({error.reason} at byte {error.start}): {AGAIN}") from error
    lines = csv.reader(io.StringIO(text, newline=""))
    found: list[tuple[str, str, Row]] = []
    header: list[str] = []
    try:
        for line in lines:
            if not header:
                header = [cell.strip() for cell in line] if line and line[0].strip() == "#name" else []
                _check_header(header, file)
                continue
            if not line or line[0].startswith("#"):
                continue
            where = f"{file}: line {lines.line_num}"
            if len(line) != len(header):
                raise UserError(f"{where} has {len(line)} values, {len(header)} are needed: {AGAIN}")
            cells = dict(zip(header, line, strict=True))
            row = {key: number_of(cells[key], f"{where}: {key}") for key in NUMBERS}
            _refuse_lens(row, where)
            found.append((cells["#name"].strip(), where, row))
    except csv.Error as error:
        raise UserError(f"{file}: line {lines.line_num} is no CSV ({shorten(str(error))}): {AGAIN}") from error
    if not found or not all(name for name, _, _ in found):
        raise UserError(f"{file} has no rows with the names of photos: {AGAIN}")
    return found


def _check_header(header: list[str], file: Path) -> None:
    """Raise UserError if columns are missing. An empty header is that of a line before the header."""
    missing = [key for key in NUMBERS if header and key not in header]
    if missing:
        raise UserError(f"{file} has no column {missing[0]}: export the internal/external camera parameters again")


def _refuse_lens(row: Row, where: str) -> None:
    for key in REFUSED:
        if row[key]:
            raise UserError(
                f"{where} has {key} = {row[key]:g}, which is not known here: choose the distortion model Brown3, "
                "or export undistorted photos with their parameters"
            )


def _camera(photo: Path, row: Row, where: str) -> Camera:
    header = measure(photo)
    width, height = header.width, header.height
    longer = max(width, height)
    focal = row["f"] * longer / FILM
    center = width / 2 + row["px"] * longer, height / 2 + row["py"] * longer
    place = np.array([row["x"], row["y"], row["alt"]])
    c2w = np.column_stack([_rotation(row["heading"], row["pitch"], row["roll"]), place])
    return checked_camera(
        where, (width, height), (focal, focal), center, c2w, Lens(k1=row["k1"], k2=row["k2"], k3=row["k3"])
    )


def _rotation(heading: float, pitch: float, roll: float) -> np.ndarray:
    """R_z(−heading) R_x(pitch) R_y(roll) of angles in degrees."""
    (a, b, c), (sa, sb, sc) = (f(np.radians([-heading, pitch, roll])) for f in (np.cos, np.sin))
    about_z = np.array([[a, -sa, 0], [sa, a, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, b, -sb], [0, sb, b]])
    about_y = np.array([[c, 0, sc], [0, 1, 0], [-sc, 0, c]])
    return about_z @ about_x @ about_y
