"""poses.txt: a line for each photo, with its name, focal length and camera-to-world matrix."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions, Photo
from nerf_core.datasets.images import measure
from nerf_core.geometry.camera import Camera

FILE = "poses.txt"


@DATASETS.register("pose-list")
class PoseList:
    """A large `rank`: `--format auto` prefers every format that the program itself knows."""

    rank: ClassVar[int] = 100
    files: ClassVar[str] = FILE

    @staticmethod
    def matches(path: Path) -> bool:
        return (path / FILE).is_file()

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Raises UserError that names the line which is wrong."""
        photos = []
        for number, line in enumerate((path / FILE).read_text(encoding="utf-8").splitlines(), 1):
            name, *values = line.split()
            try:
                focal, *pose = map(float, values)
                c2w = np.array(pose).reshape(3, 4)
            except ValueError:
                raise UserError(f"{path / FILE}: line {number}: a name and 13 numbers are needed") from None
            size = measure(path / name)
            camera = Camera(size.width, size.height, focal, focal, size.width / 2, size.height / 2, c2w)
            photos.append(Photo(name, path / name, camera))
        return Capture(format="pose-list", photos=tuple(photos))
