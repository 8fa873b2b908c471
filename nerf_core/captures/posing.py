"""Find the poses of photos or of a video's frames, and keep them as a COLMAP folder."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerf_core.captures.advice import ALIKE, reason, summary, too_few
from nerf_core.captures.raw_photos import RawPhotos
from nerf_core.captures.records import PoseOptions, PoseProgress
from nerf_core.captures.search import LENSES, QUALITIES, Job
from nerf_core.common import cache
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import locked_file, write_atomically
from nerf_core.common.json_files import read_json
from nerf_core.common.language import marked, phrase
from nerf_core.common.text import counted
from nerf_core.common.user_paths import absolute

FORMAT = 2  # of poses.json
DONE = "poses.json"
WORK = cache.WORK  # of the folder of one search; two may go on at once
WAIT_SECONDS = 600.0  # for another search to write: where a system has no links it copies all photos
LEAST_PHOTOS, LEAST_POINTS = 3, 100  # of a model: COLMAP places a photo by 30 points; fewer are chance


@dataclass(frozen=True)
class Posed:
    """Photos with poses.

    folder: a COLMAP folder: sparse/0 and images.
    names: all photos.
    unplaced: those without a pose, each with the reason.
    error: the mean distance between points and where photos show them, in pixels of the copies.
    points: of the sparse model.
    advice: what to photograph instead, or what was odd; empty: nothing.
    seconds: that it took.
    again: whether it was found from before.
    """

    folder: Path
    names: tuple[str, ...]
    unplaced: tuple[tuple[str, str], ...]
    error: float
    points: int
    advice: str
    seconds: float
    again: bool = False

    @property
    def summary(self) -> str:
        """Return how well it went, in a line."""
        return phrase(
            "{placed} of {photos} photos have a pose; {points:,} points, mean error {error:.2f} pixels",
            placed=len(self.names) - len(self.unplaced), photos=len(self.names), points=self.points, error=self.error,
        )  # fmt: skip

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what to tell the user of the photos that have no pose."""
        if not self.unplaced:
            return tuple(filter(None, [self.advice]))
        listed = "; ".join(f"{name}: {why}" for name, why in self.unplaced[:3])
        more = "" if len(self.unplaced) <= 3 else phrase("; {n} more", n=len(self.unplaced) - 3)
        return (
            phrase(
                "{placed} of {photos} photos have a pose, without one: {listed}{more}",
                placed=len(self.names) - len(self.unplaced),
                photos=len(self.names),
                listed=listed,
                more=more,
            ),
            *filter(None, [self.advice]),
        )


Progress = Callable[[PoseProgress], None]


def pose_folder(raw: RawPhotos, options: PoseOptions) -> Path:
    """Return the folder in the cache where the poses of these photos lie, or will lie."""
    return cache.entry_folder("poses", _key(raw, options), raw.name)


def find_poses(raw: RawPhotos, out: Path | None, options: PoseOptions, progress: Progress) -> Posed:
    """Find the poses of photos by structure from motion, or the result of an earlier time.

    Args:
        raw: the photos or the video.
        out: the folder for the result; None: one in the cache. Nothing is written beside the photos.
        options: the user's choices.
        progress: called from this thread, some ten times a second; what it raises ends everything.

    Returns:
        The result. `out` then holds sparse/0, images (a link to the photos, or a video's frames) and poses.json.

    Raises:
        UserError: if no pose is found, with the reason and what to photograph instead, or if a limit is reached.
            Nothing of the result is left then.
    """
    check(raw, options)
    folder = pose_folder(raw, options) if out is None else absolute(out)
    key = _key(raw, options)
    known = _known(folder, key)
    if known is not None:
        if out is None:
            cache.used(folder)
        return known
    if out is not None:
        _must_be_free(folder, raw)
    begun = time.monotonic()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=WORK) as scratch:
            work = Path(scratch)
            job = Job(raw, options, work, progress, started=begun)
            job.prepare()
            result = job.run()
            posed = _judged(job, result, folder, time.monotonic() - begun)
            job.ended(len(result["placed"]))
            with _alone(folder):
                if (other := _known(folder, key)) is not None:
                    return other  # of a search that ended first
                _keep(job, posed, folder, key)
        if out is None:
            cache.make_room(cache.folder_bytes(folder), folder)
    except OSError as error:
        where = error.filename or folder
        raise UserError(f"{where}: {error.strerror or error}: check its rights and the space on its disk") from error
    finally:
        _remove_if_empty(folder)
    return posed


def _key(raw: RawPhotos, options: PoseOptions) -> str:
    """What a result depends on."""
    frames = f"-{options.frames}" if raw.video is not None else ""
    return f"{raw.key()}-{options.quality}{frames}" + ("-fisheye" if options.lens == "fisheye" else "")


def _must_be_free(folder: Path, raw: RawPhotos) -> None:
    """Raise UserError if a folder that the user named has something in it, or has to do with the photos' folder."""
    if raw.meets(folder):
        raise UserError(f"{folder} holds the photos or lies among them: name another folder")
    if folder.exists() and (not folder.is_dir() or any(f for f in folder.iterdir() if not f.name.startswith(WORK))):
        raise UserError(f"{folder} is not empty: name a new folder")


def check(raw: RawPhotos, options: PoseOptions) -> None:
    """Raise UserError for options out of range, for too few photos, and where pycolmap is missing."""
    if options.quality not in QUALITIES:
        raise UserError(f"--quality is {shorten(options.quality)}: choose one of {', '.join(QUALITIES)}")
    if options.lens not in LENSES:
        raise UserError(f"--lens is {shorten(options.lens)}: choose {' or '.join(LENSES)}")
    if not (options.frames == 0 or 3 <= options.frames <= 5000):
        raise UserError(f"--frames is {shorten(options.frames)}: give 3 to 5000, or 0 to choose by the length")
    if not 0 < options.minutes <= 1e5:
        raise UserError(f"--minutes is {options.minutes}: give the time limit in minutes, more than 0")
    if not 0 <= options.memory_gb <= 1e5:
        raise UserError(f"--memory-gb is {options.memory_gb}: give the limit in GB, or 0 for what is free")
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(f"{raw.source} has no poses: to find them, run `pip install pycolmap`")
    if raw.video is None and (few := too_few(len(raw.photos))):
        raise UserError(f"{raw.source} holds {few}")


# ---- the result --------------------------------------------------------------------------------------------------


def _judged(job: Job, result: dict[str, Any], folder: Path, seconds: float) -> Posed:
    """Raises UserError with plain words if the photos have no poses."""
    placed = set(result["placed"])
    if len(placed) < LEAST_PHOTOS or result["points"] < LEAST_POINTS:
        words = summary({**result, "placed": []})
        raise UserError(f"{job.raw.source}: no poses were found for its {counted(len(job.names), 'photo')}. {words}")
    lost = [
        (job.names[i], reason(result["features"][i], result["best"][i]))
        for i in range(len(job.names))
        if i not in placed
    ]
    damaged = [name for name, _ in job.damaged]
    lost += [(name, marked("it cannot be read")) for name in damaged]
    words = summary(result) or (ALIKE if result["folded"][0] else "")
    return Posed(
        folder, (*job.names, *damaged), tuple(lost), result["error"], result["points"], words, seconds
    )  # fmt: skip


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Let no other search keep its result in this folder meanwhile. Raises UserError if one takes too long."""
    lock, begun = folder / f"{WORK}lock", time.monotonic()
    while True:
        file = locked_file(lock)
        if file is not None:
            with suppress(OSError):
                if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                    break
            file.close()  # the one before has removed it
        elif time.monotonic() - begun > WAIT_SECONDS:
            raise UserError(f"{folder}: another search has been writing its poses there for a while: try again later")
        time.sleep(0.01)
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file: it stays, and is locked again
            lock.unlink()
        file.close()


def _keep(job: Job, posed: Posed, folder: Path, key: str) -> None:
    """Move the result to its folder. poses.json comes last: it says that all is there. After a fault nothing stays."""
    description = {
        "format": FORMAT, "key": key, "upright": True, "names": posed.names, "unplaced": posed.unplaced,
        "error": posed.error, "points": posed.points, "advice": posed.advice, "seconds": posed.seconds,
    }  # fmt: skip
    _clear(folder)
    try:
        (job.work / "sparse").rename(folder / "sparse")
        if job.raw.video is not None:
            (job.work / "images").rename(folder / "images")
        else:
            _link(folder / "images", job.raw.root, job.photos)
        write_atomically(folder / DONE, json.dumps(description))
    except BaseException:
        _clear(folder)
        raise


def _clear(folder: Path) -> None:
    """Remove a result."""
    (folder / DONE).unlink(missing_ok=True)
    for place in (folder / "sparse", folder / "images"):
        if place.is_symlink():
            place.unlink()
        elif place.exists():
            shutil.rmtree(place)


def _link(link: Path, root: Path, photos: Sequence[Path]) -> None:
    """Make a link to the folder of the photos; where a system has no links, copy them."""
    try:
        link.symlink_to(root.resolve(), target_is_directory=True)
    except OSError:
        for photo in photos:
            copy = link / photo.relative_to(root)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(photo, copy)


def _known(folder: Path, key: str) -> Posed | None:
    """The result of an earlier time, if it is complete and of the same photos."""
    try:
        said = read_json(folder / DONE).values
        if said["format"] != FORMAT or said["key"] != key or not (folder / "sparse" / "0").is_dir():
            return None
        if not (folder / "images").is_dir():
            return None
        lost = tuple((str(name), str(why)) for name, why in said["unplaced"])
        numbers = float(said["error"]), int(said["points"]), str(said["advice"]), float(said["seconds"])
        return Posed(folder, tuple(map(str, said["names"])), lost, *numbers, again=True)
    except (OSError, UserError, ValueError, KeyError, TypeError, OverflowError):
        return None


def _remove_if_empty(folder: Path) -> None:
    """Remove a folder without a result, and the cache's folder around it."""
    for place in (folder, folder.parent):
        try:
            place.rmdir()
        except OSError:
            return
