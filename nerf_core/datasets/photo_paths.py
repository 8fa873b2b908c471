"""Find the photos that a calibration lists, even if it was written on another computer or the photos were moved."""

from __future__ import annotations

import os
import stat
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePosixPath

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrase, phrases
from nerf_core.common.names import printable
from nerf_core.datasets.images import SUFFIXES


@dataclass(frozen=True)
class Found:
    """The result of a search.

    paths: the file of each listed entry; None if there is none.
    notes: warnings about photos that were not in the listed place.
    """

    paths: tuple[Path | None, ...]
    notes: tuple[str, ...]


def find_photos(folder: Path, listed: Sequence[str], source: Path) -> Found:
    """Find the files of the entries that `source` lists, relative to `folder`, with or without extension.

    An entry that is not in its place (a path of another computer, a renamed folder, another extension) is looked up by
    name. A photo is taken if it is the only one that fits and no other entry lists it. If other entries of the same
    folder are in their place, the search stays in that folder, because a photo of the same name in another folder
    belongs to another split.
    Raises UserError if an entry is a device or pipe, or if all are missing.
    """
    exact = [_listed_file(folder, entry, source) for entry in listed]
    paths = list(exact)
    if None in exact:
        searched = _Search(folder, listed, exact)
        paths = [path or searched.find(entry) for entry, path in zip(listed, exact, strict=True)]
        shared = Counter(path for path, before in zip(paths, exact, strict=True) if path and not before)
        paths = [None if path and shared[path] > 1 else path for path in paths]
    missing = [entry for entry, path in zip(listed, paths, strict=True) if path is None]
    if len(missing) == len(listed):
        raise UserError(
            f"{source}: none of the {len(listed)} listed photos exists, tried {_tried(folder, missing[0])}: "
            "put the photos there or correct the names"
        )
    notes = []
    moved = [entry for entry, before, now in zip(listed, exact, paths, strict=True) if now and not before]
    if moved:
        notes.append(
            phrases(
                "{file}: {n:,} photo not where listed but found by name, first {first}",
                "{file}: {n:,} photos not where listed but found by name, first {first}",
                len(moved),
                file=source,
                first=shorten(moved[0]),
            )
        )
    if missing:
        notes.append(
            phrase(
                "{file}: {count} of {total} listed photos are missing, first {first}",
                file=source,
                count=len(missing),
                total=len(listed),
                first=shorten(missing[0]),
            )
        )
    outside = [path for path in paths if path and not _inside(folder, path)]
    if outside:
        notes.append(
            phrase(
                "{file}: {count} listed photos lie outside of the dataset's folder, first {first}",
                file=source,
                count=len(outside),
                first=outside[0],
            )
        )
    return Found(tuple(paths), tuple(notes))


class _Search:
    """The photos of a folder by name, without those that an entry lists exactly."""

    def __init__(self, folder: Path, listed: Sequence[str], exact: Sequence[Path | None]) -> None:
        taken = {os.path.abspath(path) for path in exact if path}
        self._homes = {_parts(entry).parent for entry, path in zip(listed, exact, strict=True) if path}
        self._by_key: dict[str, list[PurePosixPath]] = defaultdict(list)
        self._folder = folder
        for parent, _, files in os.walk(folder):
            for file in files:
                path = Path(parent, file)
                if path.suffix.lower() in SUFFIXES and os.path.abspath(path) not in taken:
                    relative = PurePosixPath(path.relative_to(folder).as_posix())
                    self._by_key[file.lower()].append(relative)
                    self._by_key[path.stem.lower()].append(relative)

    def find(self, entry: str) -> Path | None:
        wanted = _parts(entry)
        for key in (wanted.name.lower(), wanted.stem.lower()):
            candidates = self._by_key.get(key, [])
            if wanted.parent in self._homes:
                candidates = [c for c in candidates if c.parent == wanted.parent]
            if candidates:
                return self._best(wanted, candidates)
        return None

    def _best(self, wanted: PurePosixPath, candidates: list[PurePosixPath]) -> Path | None:
        """The candidate that shares the most folders with the listed path, counted from the end; None for a tie."""
        ranked = sorted(((_agreement(wanted, c), c) for c in candidates), reverse=True)
        if len(ranked) > 1 and ranked[0][0] == ranked[1][0]:
            return None
        return self._folder / ranked[0][1]


def _parts(entry: str) -> PurePosixPath:
    return PurePosixPath(entry.replace("\\", "/"))


def _agreement(a: PurePosixPath, b: PurePosixPath) -> int:
    count = 0
    for x, y in zip(reversed(a.parent.parts), reversed(b.parent.parts), strict=False):
        if x != y:
            break
        count += 1
    return count


def photo_name(folder: Path, path: Path) -> str:
    """Return the path relative to the folder with forward slashes; outside the folder, the whole path without root."""
    plain, base = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    return (plain.relative_to(base) if plain.is_relative_to(base) else plain.relative_to(plain.anchor)).as_posix()


def _inside(folder: Path, path: Path) -> bool:
    return Path(os.path.abspath(path)).is_relative_to(os.path.abspath(folder))


def _tried(folder: Path, entry: str) -> str:
    text = printable(folder / entry)
    return text if len(text) < 500 else shorten(text)


def _mode(path: Path) -> int | None:
    """The file's mode bits; None if there is no file, or if no file can have that name."""
    try:
        return path.stat().st_mode
    except (OSError, ValueError):
        return None


def _listed_file(folder: Path, entry: str, source: Path) -> Path | None:
    """The listed file itself, or with one of the usual extensions if the entry has none; None if there is none."""
    path = folder / entry
    for candidate in chain((path,), (path.parent / (path.name + suffix) for suffix in SUFFIXES)):
        mode = _mode(candidate)
        if mode is None:
            continue
        if stat.S_ISREG(mode):
            return candidate
        if not stat.S_ISDIR(mode):
            raise UserError(
                f"{source}: lists {shorten(entry)}, a device or a pipe, not a photo: list regular image files only"
            )
    return None
