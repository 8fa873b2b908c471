"""The NeRF paper's synthetic scenes: transforms_{train,val,test}.json beside photos rendered by Blender."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.json_files import read_json
from nerf_core.common.language import phrase
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions
from nerf_core.datasets.json_frames import Frame, bounds, frames_of, gather
from nerf_core.datasets.rig import common_focus
from nerf_core.geometry.scene import SPLITS

NEAR, FAR = 2.0, 6.0  # of the official Blender configurations; the objects fill a ball of radius 1.5 seen from 4


def _file(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


@DATASETS.register("blender")
class Blender:
    """Known bounds and z up. `near` and `far` (z-depths) in transforms_train.json replace the bounds 2 and 6."""

    rank: ClassVar[int] = 0
    files: ClassVar[str] = "transforms_train.json"

    @staticmethod
    def matches(path: Path) -> bool:
        files = [_file(path if path.is_dir() else path.parent, split) for split in SPLITS]
        return any(f.is_file() for f in files) and (path.is_dir() or path in files)

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos of all splits. Raises UserError that names file, field and remedy."""
        folder = path if path.is_dir() else path.parent
        train = _file(folder, "train")
        if not train.exists():
            raise UserError(f"{train} does not exist: Blender's format needs it, with the photos to train on")
        documents = {split: read_json(_file(folder, split)) for split in SPLITS if _file(folder, split).exists()}
        frames: list[Frame] = []
        for split, document in documents.items():
            frames += frames_of(document, split)
        found = gather(folder, frames, train if len(documents) == 1 else folder)
        stated = bounds(documents["train"])
        (near, far), notes = (stated, ()) if stated else _usual_bounds([photo.camera.c2w for photo in found.photos])
        splits = {
            split: tuple(i for i, f in zip(found.index, frames, strict=True) if f.split == split and i is not None)
            for split in documents
        }
        return Capture(
            format="blender",
            photos=found.photos,
            splits=splits,
            near=near,
            far=far,
            synthetic=True,
            up=np.array([0.0, 0.0, 1.0]),
            notes=(*found.notes, *notes),
        )


def _usual_bounds(poses: Sequence[np.ndarray]) -> tuple[tuple[float, float], tuple[str, ...]]:
    """The official bounds, and no note. In another unit, bounds as far from the cameras' focus in proportion, and a
    note."""
    focus = common_focus(np.stack(poses))
    if focus is None:
        return (NEAR, FAR), ()
    distance = float(np.median(np.linalg.norm(np.stack(poses)[:, :, 3] - focus, axis=1)))
    if NEAR < distance < FAR:
        return (NEAR, FAR), ()
    near, far = (2 * bound / (NEAR + FAR) * distance for bound in (NEAR, FAR))
    note = phrase(
        "the cameras look at a point {distance:.4g} away, not between {near:g} and {far:g} as is usual: bounds are "
        "taken in proportion; near and far in transforms_train.json would tell",
        distance=distance,
        near=NEAR,
        far=FAR,
    )
    return (near, far), (note,)
