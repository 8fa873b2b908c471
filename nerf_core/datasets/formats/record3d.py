"""Record3D's export: a file metadata with one calibration and the poses of all photos, beside folders of photos.

Written from what the app's author says in github.com/marek-simonik/record3d (issues 27, 33, 36, 53, 67 and 93), and
from nerfstudio's reader. `K` is a 3 × 3 matrix of intrinsics, column by column. Each of `poses` is a quaternion and a
position, qx qy qz qw px py pz: camera to world, with OpenGL's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.json_files import LIMIT, Fields, read_json
from nerf_core.common.language import phrase
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions, Photo
from nerf_core.datasets.depth_maps import DepthMap, recorded_depths
from nerf_core.datasets.posed_files import (
    Posed,
    begins_with,
    checked_camera,
    posed_photos,
    quaternion_rotation,
)

FILES = ("metadata.json", "metadata")  # of the export as EXR and JPG, and in an unpacked .r3d file
PHOTOS = ("rgb", "rgbd")
DEPTHS = "depth"
SUFFIXES = (".jpg", ".jpeg", ".png")


@DATASETS.register("record3d")
class Record3D:
    """Photos are numbered, and photo k has pose k. Depth maps in EXR tell the bounds.

    Those of a .r3d file are not read: they are compressed by LZFSE.
    """

    rank: ClassVar[int] = 6
    files: ClassVar[str] = "metadata.json with rgb"

    @staticmethod
    def matches(path: Path) -> bool:
        return path.is_dir() and _file(path) is not None and _photos(path) is not None

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by number. Raises UserError."""
        file, photos = _file(path), _photos(path)
        if file is None or photos is None:
            raise UserError(
                f"{path} has no {FILES[0]} beside a folder {PHOTOS[0]} with numbered photos: export it again"
            )
        fields = read_json(file, "an object with K and poses")
        size = fields.count("w"), fields.count("h")
        fx, _, _, _, fy, _, cx, cy, _ = _numbers(fields.values.get("K"), 9, f"{file}: K")
        poses = _poses(fields)
        numbers = {int(p.stem): p for p in photos if int(p.stem) < len(poses)}
        entries = []
        for k, photo in sorted(numbers.items()):
            where = f"{file}: poses[{k}]"
            c2w = np.column_stack([quaternion_rotation(poses[k, :4], where), poses[k, 4:]])
            camera = checked_camera(where, size, (fx, fy), (cx, cy), c2w)
            entries.append(Posed(photo.relative_to(path).as_posix(), lambda _, camera=camera: camera))
        if not entries:
            raise UserError(f"{file} has {len(poses)} poses, but no photo from 0 to {len(poses) - 1}: export it again")
        found, notes = posed_photos(path, file, entries)
        if not len(photos) == len(poses) == len(numbers):
            notes += (
                phrase(
                    "{file} has {poses:,} poses, and {folder} {photos:,} photos: those of equal numbers are taken",
                    file=file,
                    poses=len(poses),
                    folder=photos[0].parent,
                    photos=len(photos),
                ),
            )
        maps = [DepthMap(file, size) for file in sorted(_depth_maps(path, found))]
        depths, depth_notes = recorded_depths(maps) if maps else (None, ())
        return Capture(format="record3d", photos=found, depths=depths, notes=notes + depth_notes)


def _file(path: Path) -> Path | None:
    return next((path / name for name in FILES if begins_with(path / name, b"{")), None)


def _depth_maps(path: Path, photos: Sequence[Photo]) -> list[Path]:
    """The depth maps of photos: depth/k.exr for rgb/k.jpg, float32 in metres in the red channel (issues 53 and 67)."""
    return [file for p in photos if (file := path / DEPTHS / f"{p.path.stem}.exr").is_file()]


def _photos(path: Path) -> list[Path] | None:
    """The numbered photos of the first folder that has some."""
    for name in PHOTOS:
        folder = path / name
        if folder.is_dir():
            files = [
                f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.stem.isdecimal() and len(f.stem) < 9
            ]
            if files:
                return sorted(files, key=lambda f: (int(f.stem), f.name))
    return None


def _poses(fields: Fields) -> np.ndarray:
    """The rows of `poses` as an array (N, 7)."""
    rows = fields.values.get("poses")
    if not isinstance(rows, list) or not rows:
        raise fields.error("poses", "a list with at least one entry is needed")
    return np.array([_numbers(row, 7, f"{fields.file}: poses[{i}]") for i, row in enumerate(rows)])


def _numbers(values: Any, count: int, where: str) -> list[float]:
    numeric = isinstance(values, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if not numeric or len(values) != count or any(abs(v) > LIMIT for v in values):
        raise UserError(f"{where} is {shorten(values)}: {count} numbers between ±{LIMIT:g} are needed")
    return [float(v) for v in values]
