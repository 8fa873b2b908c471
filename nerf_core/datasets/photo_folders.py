"""Choose which folder of a capture to load photos from: images, images_2, images_4 …"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerf_core.common.language import phrase
from nerf_core.datasets.images import SUFFIXES

FOLDER = re.compile(r"images(?:_([1-9][0-9]{0,3}))?")
MASK_FOLDERS = ("masks", "mask")  # beside the photos, or among them
MASK_END = ".mask.png"  # of the mask that lies beside its photo


@dataclass(frozen=True)
class PhotoFolder:
    """A folder of photos.

    reduced: how many times smaller than full size its photos are.
    files: the image files below it, sorted by name.
    """

    path: Path
    reduced: int
    files: tuple[Path, ...]


def photo_folders(root: Path) -> tuple[PhotoFolder, ...]:
    """Return the folders images and images_N of `root`, largest photos first."""
    found = [(int(match[1] or 1), path) for path in root.iterdir() if (match := FOLDER.fullmatch(path.name))]
    return tuple(PhotoFolder(path, reduced, photos_below(path)) for reduced, path in sorted(found) if path.is_dir())


def photos_below(folder: Path) -> tuple[Path, ...]:
    """Return the image files below a folder, sorted by name, without masks and hidden ones (macOS: ._0001.jpg)."""
    files = sorted(f for f in folder.rglob("*") if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    return tuple(
        f for f in files if not f.name.lower().endswith(MASK_END) and f.relative_to(folder).parts[0] not in MASK_FOLDERS
    )


def choose_folder(
    folders: Sequence[PhotoFolder], downscale: int, count: int, present: Callable[[PhotoFolder], int]
) -> tuple[PhotoFolder, tuple[str, ...]]:
    """Choose the complete folder whose photos already have the wanted size.

    If there is none it is the complete folder with the largest photos; if no folder is complete, the one with most.

    Args:
        folders: at least one.
        downscale: the reduction that the user asked for.
        count: the number of photos that there should be.
        present: returns how many of them a folder has.

    Returns:
        The folder, and notes.
    """
    has = {folder: present(folder) for folder in folders}
    usable = [folder for folder in folders if has[folder] == count] or [max(folders, key=lambda folder: has[folder])]
    chosen = next((folder for folder in usable if folder.reduced == downscale), usable[0])
    notes = tuple(
        phrase(
            "{folder} has {found} of {count} photos and is passed over",
            folder=folder.path,
            found=has[folder],
            count=count,
        )
        for folder in folders
        if has[folder] != count and folder is not chosen
    )
    if chosen.reduced > downscale:
        notes += (
            phrase(
                "{folder} has the largest photos, {times} times smaller than full size: they are used",
                folder=chosen.path,
                times=chosen.reduced,
            ),
        )
    return chosen, notes
