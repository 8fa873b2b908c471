"""transforms.json of instant-ngp and nerfstudio: posed photos with one lens for all frames or one for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import ClassVar

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.json_files import Fields, read_json
from nerf_core.common.language import phrase, phrases
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions
from nerf_core.datasets.json_frames import Frame, bounds, frames_of, gather
from nerf_core.geometry.scene import SPLITS


@DATASETS.register("transforms")
class Transforms:
    """Poses are read as they are. scale, offset, aabb_scale and applied_transform are for other programs' frames."""

    rank: ClassVar[int] = 1
    files: ClassVar[str] = "transforms.json"

    @staticmethod
    def matches(path: Path) -> bool:
        return (path / "transforms.json").is_file() if path.is_dir() else path.suffix.lower() == ".json"

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by name, like nerfstudio before it splits them. Raises UserError."""
        file = path / "transforms.json" if path.is_dir() else path
        document = read_json(file)
        frames = sorted(frames_of(document), key=lambda frame: frame.listed)
        found = gather(file.parent, frames, file)
        near, far = bounds(document) or (None, None)
        capture = Capture(format="transforms", photos=found.photos, near=near, far=far, notes=found.notes)
        return _with_named_splits(capture, document, frames, found.index)


def _with_named_splits(
    capture: Capture, document: Fields, frames: Sequence[Frame], index: Sequence[int | None]
) -> Capture:
    """Apply nerfstudio's {train,val,test}_filenames. Frames in none of them are left out, as in nerfstudio."""
    names = {split: document.texts(key) for split in SPLITS if (key := f"{split}_filenames") in document}
    if not names:
        return capture
    if "train" not in names:
        raise UserError(f"{document.file}: train_filenames is missing beside {next(iter(names))}_filenames: add it")
    place = {PurePosixPath(frame.listed): i for frame, i in zip(frames, index, strict=True) if i is not None}
    listed = {PurePosixPath(frame.listed) for frame in frames}
    unknown = [name for split in names.values() for name in split if PurePosixPath(name) not in listed]
    splits = {
        split: tuple(sorted({place[p] for name in values if (p := PurePosixPath(name)) in place}))
        for split, values in names.items()
    }
    kept = sorted({i for values in splits.values() for i in values})
    notes = list(capture.notes)
    if unknown:
        notes.append(
            phrase(
                "{file}: {count} names of its splits are in no frame, first {first}",
                file=document.file,
                count=len(unknown),
                first=shorten(unknown[0]),
            )
        )
    if len(kept) < len(capture.photos):
        notes.append(
            phrases(
                "{file}: {n:,} photo in no split, left out",
                "{file}: {n:,} photos in no split, left out",
                len(capture.photos) - len(kept),
                file=document.file,
            )
        )
    return replace(capture, splits=splits, notes=tuple(notes)).keeping(kept)
