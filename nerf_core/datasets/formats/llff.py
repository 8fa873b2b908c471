"""Local light field fusion (LLFF): poses_bounds.npy beside folders with the photos of one lens in several sizes."""

from __future__ import annotations

import math
import tokenize
import warnings
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions, Photo
from nerf_core.datasets.photo_folders import PhotoFolder, choose_folder, photo_folders
from nerf_core.datasets.photo_paths import photo_name
from nerf_core.geometry.camera import Camera

FILE = "poses_bounds.npy"
COLUMNS = 17  # a 3×5 matrix [rotation | position | height, width, focal], then near and far
LIMIT = 1e12  # larger than any length in any unit; its inverse is smaller than any
STRETCH = 1.05  # a larger ratio between the lengths of a rotation's axes is a shear, not rounding
AGAIN = "export it again with LLFF's imgs2poses.py"


@DATASETS.register("llff")
class Llff:
    """LLFF captures, forward-facing or not. Sizes and focal length are those of the full-size photos; no distortion."""

    rank: ClassVar[int] = 3
    files: ClassVar[str] = f"{FILE} with images"

    @staticmethod
    def matches(path: Path) -> bool:
        return path.is_dir() and (path / FILE).is_file()

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos of the best complete folder, sorted by name like the rows of the table. Raises UserError."""
        root = path if path.is_dir() else path.parent
        table = read_table(root / FILE)
        folder, notes = _folder(root, len(table), options.downscale)
        photos = tuple(
            Photo(photo_name(root, file), file, _camera(row, root / FILE, i))
            for i, (row, file) in enumerate(zip(table, folder.files, strict=True))
        )
        return Capture(
            format="llff",
            photos=photos,
            bounds_per_photo=_bounds(table, root / FILE),
            ndc_capable=True,
            reduced=folder.reduced,
            notes=notes,
        )


def read_table(file: Path) -> np.ndarray:
    """Read poses_bounds.npy as (N, 17) float64.

    Nothing is unpickled, and no more memory is allocated than the file has bytes.
    Raises UserError for other types and shapes, for a file that is cut off, and for numbers that are not finite.
    """
    if not file.is_file():
        raise UserError(f"{file} is not a regular file: name a folder that holds LLFF's {FILE}")
    size = file.stat().st_size
    with file.open("rb") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            with warnings.catch_warnings():  # NumPy warns of headers that Python 2 may have written, and reads them
                warnings.simplefilter("ignore", UserWarning)
                shape, _, dtype = header(stream)
        except (ValueError, SyntaxError, TypeError, tokenize.TokenError, RecursionError) as error:
            raise UserError(f"{file} is not an array that NumPy can read ({shorten(str(error))}): {AGAIN}") from error
        if dtype.kind not in "fiu":
            raise UserError(f"{file} holds {shorten(str(dtype))} values: numbers are needed, {AGAIN}")
        if len(shape) != 2 or shape[1] != COLUMNS or shape[0] < 1:
            raise UserError(f"{file} has the shape {shorten(shape)}: one row of {COLUMNS} numbers a photo is needed")
        expected = stream.tell() + math.prod(shape) * dtype.itemsize
        if size != expected:
            raise UserError(f"{file} has {size:,} bytes, but its header claims {expected:,}: {AGAIN}")
        stream.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            table = np.load(stream, allow_pickle=False).astype(np.float64)
    odd = np.argwhere(~(np.abs(table) <= LIMIT))
    if len(odd):
        row, column = odd[0]
        raise UserError(
            f"{file}: row {row}, column {column} is {table[row, column]:g}: a number between ±{LIMIT:g} is needed"
        )
    return table


def _bounds(table: np.ndarray, file: Path) -> np.ndarray:
    near, far = table[:, 15], table[:, 16]
    wrong = np.flatnonzero(~((near >= 1 / LIMIT) & (near < far)))
    if len(wrong):
        i = wrong[0]
        raise UserError(f"{file}: row {i} has the depth bounds {near[i]:g} … {far[i]:g}: 0 < near < far is needed")
    return table[:, 15:]


def _camera(row: np.ndarray, file: Path, index: int) -> Camera:
    """The camera of a row. The stored axes are [down, right, back]: x = right, y = −down, z = back."""
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4]
    if min(height, width) < 1 or width != round(width) or height != round(height) or focal < 1e-4 * width:
        raise UserError(
            f"{file}: row {index} has height {height:g}, width {width:g}, focal length {focal:g}: whole sizes and a "
            f"focal length in pixels are needed, {AGAIN}"
        )
    axes = np.stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2]], axis=1)
    u, lengths, vt = np.linalg.svd(axes)
    rotation = u @ vt  # the nearest rotation (polar decomposition), because files hold rounded axes
    if not 0 < lengths[0] < STRETCH * lengths[2] or np.linalg.det(rotation) < 0:
        raise UserError(f"{file}: the axes of row {index} are sheared, singular or mirrored: a rotation is needed")
    c2w = np.column_stack([rotation, matrix[:, 3]])
    return Camera(int(width), int(height), focal, focal, width / 2, height / 2, c2w)


def _folder(root: Path, rows: int, downscale: int) -> tuple[PhotoFolder, tuple[str, ...]]:
    folders = photo_folders(root)
    if not folders:
        raise UserError(f"{root} has {FILE}, but no folder images or images_4: put the photos that were posed there")
    chosen, notes = choose_folder(folders, downscale, rows, lambda folder: len(folder.files))
    if len(chosen.files) != rows:
        counts = ", ".join(f"{folder.path.name} has {len(folder.files)}" for folder in folders)
        raise UserError(
            f"{root / FILE} has {rows} rows, but no folder as many photos ({counts}): "
            "put the photos that were posed there, and no others"
        )
    return chosen, notes
