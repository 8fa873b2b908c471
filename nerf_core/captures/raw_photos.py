"""Recognise photos and videos without poses."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from nerf_core.common.assets import assets_dir
from nerf_core.common.errors import UserError
from nerf_core.common.user_paths import absolute
from nerf_core.datasets.capture import DATASETS
from nerf_core.datasets.images import SUFFIXES
from nerf_core.datasets.masks import masks_beside
from nerf_core.datasets.photo_folders import MASK_END, photo_folders

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")


@dataclass(frozen=True)
class RawPhotos:
    """Photos or a video without poses.

    source: what the user named.
    root: the folder of the photos; for a video, its folder.
    photos: absolute paths, sorted by name; empty for a video.
    video: the video, or None.
    """

    source: Path
    root: Path
    photos: tuple[Path, ...]
    video: Path | None = None

    @property
    def name(self) -> str:
        """Return what to call the capture."""
        return self.source.resolve().stem if self.video is not None else self.source.resolve().name

    def meets(self, folder: Path) -> bool:
        """Return whether a folder holds the photos, lies among them, or is what the user named."""
        own = folder.resolve()
        places = {self.source.resolve(), *(photo.parent.resolve() for photo in self.photos)}
        return any(own == one or own in one.parents or one in own.parents for one in places)

    def masks(self) -> list[Path | None]:
        """Return the mask that lies beside each photo, if one does."""
        return masks_beside(self.photos)

    def key(self) -> str:
        """Return a digest of the files' places, sizes and times of change: other files, or masks, give another."""
        files = [self.video] if self.video is not None else [*self.photos, *filter(None, self.masks())]
        found = [(str(f.resolve()), (s := f.stat()).st_size, s.st_mtime_ns) for f in files]
        return hashlib.sha256(json.dumps(found).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def raw_photos(path: Path | None) -> RawPhotos | None:
    """Return what a path holds that has no poses; None: a format reads it, or it has no photo.

    In a folder, the photos themselves count first, then those in images, then those in all folders directly below. A
    folder without photos but with one video is that video. Masks and hidden files are no photos.
    Raises UserError for a folder that cannot be read, and for one with several videos.
    """
    if path is None or path == assets_dir():
        return None
    path = absolute(path)
    try:
        return _found(path)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}: check the folder and its rights") from error


def _found(path: Path) -> RawPhotos | None:
    if path.is_file():
        return RawPhotos(path, path.parent, (), path) if path.suffix.lower() in VIDEOS else None
    if not path.is_dir() or is_capture(path):
        return None
    photos, root = _photos(path), path
    if not photos:
        inside = [f for f in sorted(path.iterdir()) if f.is_dir() and not f.name.startswith((".", "__", "mask"))]
        if any(map(is_capture, inside)):
            return None  # that capture is meant, and the error says so
        folders = photo_folders(path)
        if folders and folders[0].files:
            root, photos = folders[0].path, tuple(f for f in folders[0].files if f.is_file())
        else:
            photos = tuple(photo for folder in inside for photo in _photos(folder))
    if photos:
        return RawPhotos(path, root, photos)
    videos = [f for f in path.iterdir() if f.suffix.lower() in VIDEOS and not f.name.startswith(".") and f.is_file()]
    if len(videos) > 1:
        names = ", ".join(sorted(f.name for f in videos)[:5])
        raise UserError(f"{path} holds {len(videos)} videos ({names}): name one of them")
    return RawPhotos(path, path, (), videos[0]) if videos else None


def is_capture(path: Path) -> bool:
    """Return whether a format with poses reads a path."""
    return any(DATASETS.get(name).matches(path) for name in DATASETS.names())


def _photos(folder: Path) -> tuple[Path, ...]:
    """The photos directly in a folder, sorted by name."""
    return tuple(
        sorted(
            f
            for f in folder.iterdir()
            if f.suffix.lower() in SUFFIXES
            and not f.name.startswith(".")
            and not f.name.lower().endswith(MASK_END)
            and f.is_file()
        )
    )
