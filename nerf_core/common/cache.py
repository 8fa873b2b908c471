"""The cache folder: what was found or read once and can be found or read again. It is bounded.

An entry is a folder KIND/KEY/NAME. Its key says what it was made of, and its name is that of the capture.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from nerf_core.common.files import PREFIX
from nerf_core.common.names import printable

KINDS = {"poses": "poses that were found", "photos": "photos of large captures, at the size that was asked for"}
FIRST = {"poses": "poses.json", "photos": "there"}  # the file that says what else is there
OTHERS = {"poses": ("sparse", "images"), "photos": ("pixels",)}
WORK = ".work-"  # begins the names of what is being made, or was when a process was killed
MOST_BYTES = 20e9  # of all entries together, unless the one in use is larger alone


@dataclass(frozen=True)
class Entry:
    """One entry.

    kind: one of KINDS.
    folder: KIND/KEY in the cache.
    name: the capture's.
    bytes: what its files take on the disk.
    used: when it was last opened, in seconds since 1970.
    """

    kind: str
    folder: Path
    name: str
    bytes: int
    used: float


def cache_folder() -> Path:
    """Return the cache folder, which may not exist."""
    import platformdirs

    return platformdirs.user_cache_path("nerf-viewer")


def entry_folder(kind: str, key: str, name: str) -> Path:
    """Return the folder of an entry, which may not exist. name: any; it is shortened to what systems allow."""
    return cache_folder() / kind / key / (printable(name)[:60] or "photos")


def holds(kind: str, folder: Path) -> bool:
    """Return whether a folder lies in the cache, among the entries of this kind."""
    return folder.absolute().is_relative_to((cache_folder() / kind).absolute())


def entries() -> list[Entry]:
    """Return all entries, the one that was used last first.

    What cannot be read is left out, and so is what was not made here: the folder may be a link to a shared disk.
    """
    found = []
    for kind in KINDS:
        for folder in _folders(cache_folder() / kind):
            try:
                used = folder.stat().st_mtime
                (inside,) = folder.iterdir()
                if not inside.is_dir() or inside.is_symlink() or not _is_ours(kind, inside):
                    continue
            except (OSError, ValueError):
                continue
            found.append(Entry(kind, folder, inside.name, folder_bytes(folder), used))
    return sorted(found, key=lambda entry: -entry.used)


def used(folder: Path) -> None:
    """Note that an entry is used now: others are deleted before it. folder: that of `entry_folder`."""
    with suppress(OSError):  # a cache that cannot be written can still be read
        os.utime(folder.parent)


def make_room(wanted: int, keep: Path) -> None:
    """Delete the entries that were not used for longest, until `wanted` more bytes fit into MOST_BYTES.

    keep: an entry's folder, which stays; see `entry_folder`.
    """
    others = [entry for entry in entries() if entry.folder != keep.parent]
    total = sum(entry.bytes for entry in others) + wanted
    while others and total > MOST_BYTES:
        oldest = others.pop()
        total -= oldest.bytes
        delete(oldest)


def clear(found: Sequence[Entry]) -> list[Entry]:
    """Delete entries and return those that could not be deleted. Whoever has one open keeps it until it is closed."""
    return [entry for entry in found if not delete(entry)]


def delete(entry: Entry) -> bool:
    """Delete an entry and return whether it has gone. The file that says what else is there goes first."""
    with suppress(OSError):
        (entry.folder / entry.name / FIRST[entry.kind]).unlink()
    shutil.rmtree(entry.folder, ignore_errors=True)
    return not entry.folder.exists()


def _is_ours(kind: str, folder: Path) -> bool:
    """Return whether a folder KIND/KEY/NAME holds what is kept there, and nothing else."""
    inside = list(folder.iterdir())
    made = [f for f in inside if (f.name == FIRST[kind] and f.is_file()) or f.name.startswith((WORK, PREFIX))]
    return bool(made) and all(f in made or f.name in OTHERS[kind] for f in inside)


def _folders(place: Path) -> list[Path]:
    try:
        return sorted(f for f in place.iterdir() if f.is_dir() and not f.is_symlink())
    except OSError:
        return []


def folder_bytes(folder: Path) -> int:
    """Return what the files below a folder take on the disk, in bytes.

    Links are not followed: they lead to the user's own photos.
    """
    total = 0
    for place, _, files in os.walk(folder):
        for name in files:
            try:
                found = os.lstat(os.path.join(place, name))
            except OSError:
                continue
            total += getattr(found, "st_blocks", 0) * 512 or found.st_size
    return total
