"""Which of images, images_2, images_4 … of a capture to load photos from."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerf_core.datasets.images import SUFFIXES

FOLDER = re.compile(r"images(?:_([1-9][0-9]{0,3}))?")


@dataclass(frozen=True)
class PhotoFolder:
    """reduced: how many times smaller than full size its photos are. files: image files below it, sorted by name."""

    path: Path
    reduced: int
    files: tuple[Path, ...]


def photo_folders(root: Path) -> tuple[PhotoFolder, ...]:
    """The folders images and images_N of `root`, largest photos first."""
    found = [(int(match[1] or 1), path) for path in root.iterdir() if (match := FOLDER.fullmatch(path.name))]
    return tuple(PhotoFolder(path, reduced, photos_below(path)) for reduced, path in sorted(found) if path.is_dir())


def photos_below(folder: Path) -> tuple[Path, ...]:
    """Image files by their names, sorted; hidden ones (macOS' ._0001.jpg) are none."""
    return tuple(sorted(f for f in folder.rglob("*") if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")))


def choose_folder(
    folders: Sequence[PhotoFolder], downscale: int, count: int, present: Callable[[PhotoFolder], int]
) -> tuple[PhotoFolder, tuple[str, ...]]:
    """The complete folder that needs no more downscaling, else the largest complete one, else the fullest; notes.

    folders: at least one. count: how many photos there should be. present: how many of them a folder has.
    """
    has = {folder: present(folder) for folder in folders}
    usable = [folder for folder in folders if has[folder] == count] or [max(folders, key=lambda folder: has[folder])]
    chosen = next((folder for folder in usable if folder.reduced == downscale), usable[0])
    notes = tuple(
        f"{folder.path} has {has[folder]} of {count} photos and is passed over"
        for folder in folders
        if has[folder] != count and folder is not chosen
    )
    if chosen.reduced > downscale:
        notes += (
            f"{chosen.path} has the largest photos, {chosen.reduced} times smaller than full size: they are used",
        )
    return chosen, notes
