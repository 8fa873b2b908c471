"""One search for poses: the photos' copies, the program that looks at them, and its limits."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from nerf_core.captures.advice import too_few
from nerf_core.captures.child import Child
from nerf_core.captures.panoramas import is_panorama
from nerf_core.captures.raw_photos import RawPhotos
from nerf_core.captures.records import (
    COPYING,
    PLACED,
    STAGES,
    Growing,
    PoseOptions,
    PoseProgress,
    thumbnails_of,
)
from nerf_core.captures.video_frames import write_frames
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.memory import free_memory
from nerf_core.common.text import counted, duration
from nerf_core.datasets.capture import Photo
from nerf_core.datasets.images import BROKEN, UnreadableError, measure, read_photo
from nerf_core.datasets.masks import kept_pixels
from nerf_core.geometry.camera import Camera

PROGRAM = Path(__file__).with_name("sfm_program.py")
STALLED = 900.0  # seconds without a sign of life: one pair of photos, or one adjustment of a thousand, takes less
POLL_SECONDS = 0.1
THUMBNAIL = 160  # pixels of its longer side
MEMORY_SHARE = 0.75  # of the memory that is free, for the program
FULL = 20_000_000  # bytes: a disk with less is what a search failed for
COPY_QUALITY = 95  # of JPEG: its artefacts are then below SIFT's noise
ALL_PAIRS = 120  # photos: up to here every pair is matched, 7,140 of them
NEAR = 20  # photos that each is matched with above that, and 10 in the order of a video
NEAR_IN_VIDEO = 10
SEED = 0
# The longer side of the copies, the most features of a photo, and SIFT's first octave: −1 doubles the picture first.
QUALITIES: dict[str, tuple[int, int, int]] = {
    "fast": (1000, 2048, 0),
    "normal": (1600, 4096, 0),
    "high": (3200, 8192, -1),
}


# COLMAP's camera model, and the focal length that it begins with in longer sides of a photo, where EXIF has none. The
# perspective one is COLMAP's own; of fisheye lenses, action cameras have some 0.45 and circles of 180° have 0.3.
LENSES: dict[str, tuple[str, float]] = {"perspective": ("SIMPLE_RADIAL", 1.2), "fisheye": ("OPENCV_FISHEYE", 0.4)}


@dataclass
class Job:
    """One search for poses, in the folder `work`."""

    raw: RawPhotos
    options: PoseOptions
    work: Path
    tell: Callable[[PoseProgress], None]
    photos: tuple[Path, ...] = ()  # the originals
    names: list[str] = field(default_factory=list)  # of the originals, below `images`
    damaged: list[tuple[str, str]] = field(default_factory=list)  # names, and what is wrong
    panoramas: int = 0  # photos that show all around
    state: PoseProgress = field(default_factory=lambda: PoseProgress(""))
    begun: float = 0.0  # the time at which the stage began
    started: float = 0.0  # the time at which the search began

    @property
    def images(self) -> Path:
        """The folder of the originals."""
        return self.work / "images" if self.raw.video is not None else self.raw.root

    # ---- photos

    def prepare(self) -> None:
        """Write the task: small upright copies of the photos, which pycolmap can read whatever the originals are."""
        self.photos = self.raw.photos
        if self.raw.video is not None:
            self.images.mkdir()
            self.photos = write_frames(self.raw.video, self.images, self.options.frames, self._stage)
            if few := too_few(len(self.photos)):
                raise UserError(
                    f"{self.raw.video} gives {few}: in it the camera hardly moves: film while walking around the object"
                )
        side, features, octave = QUALITIES[self.options.quality]
        sizes, copies, groups = list[tuple[int, int]](), list[str](), dict[tuple[int | str, ...], int]()
        masks = self.raw.masks() or [None] * len(self.photos)
        for k, (photo, mask) in enumerate(zip(self.photos, masks, strict=True)):
            self._stage(COPYING, k, len(self.photos))
            try:
                size, lens = self._copy(photo, mask, side, k, groups)
            except UnreadableError as error:
                self.damaged.append((photo.relative_to(self.images).as_posix(), str(error)))
                continue
            sizes.append(size)
            copies.append(lens)
            self.names.append(photo.relative_to(self.images).as_posix())
        if few := too_few(len(self.names)):
            damaged = f"{len(self.damaged)} of {counted(len(self.photos), 'photo')} cannot be read"
            raise UserError(f"{self.raw.source}: {damaged} (first {self.damaged[0][1]}), which leaves {few}")
        if self.panoramas > len(copies) / 2:
            raise UserError(
                f"{self.raw.source} holds 360° panoramas, whose poses are not searched for: cut perspective views out "
                "of them (ffmpeg's filter v360), or add a file with their poses, as Metashape's cameras.xml"
            )
        if masked := (self.work / "masks").exists():
            self._complete_masks(copies)
        video = self.raw.video is not None
        task: dict[str, Any] = {
            "names": self.names, "sizes": sizes, "copies": copies, "side": side, "features": features, "octave": octave,
            "pairs": "all" if len(copies) <= ALL_PAIRS else "video" if video else "alike",
            "masked": masked, "lens": LENSES[self.options.lens],
            "near": NEAR_IN_VIDEO if video else NEAR, "threads": max(1, os.cpu_count() or 1), "seed": SEED,
        }  # fmt: skip
        (self.work / "task.json").write_text(json.dumps(task), "utf-8")

    def _copy(
        self, photo: Path, mask: Path | None, side: int, k: int, groups: dict[tuple[int | str, ...], int]
    ) -> tuple[tuple[int, int], str]:
        """Write the copies of a photo and its mask. Returns the upright size and the copy's name below photos/."""
        header = measure(photo)
        size = (header.width, header.height) if header.orientation < 5 else (header.height, header.width)
        scale = min(1.0, side / max(size))
        small = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        pixels = read_photo(photo, small, (0.0, 0.0, 0.0), upright=True)
        levels = (pixels >> 8).astype(np.uint8)
        self.panoramas += is_panorama(levels)
        made_by, focal = _camera_of(photo)
        group = groups.setdefault((*size, made_by, focal), len(groups))
        name = f"{group}/{k:06d}.jpg"
        file = self.work / "photos" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        if focal:  # the focal length that a camera writes is a better start than COLMAP's guess
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
        copy = Image.fromarray(levels)
        copy.save(file, quality=COPY_QUALITY, subsampling=0, exif=exif)
        if k in thumbnails_of(len(self.photos)):
            copy.thumbnail((THUMBNAIL, THUMBNAIL))
            small_copy = np.asarray(copy.convert("RGBA"))
            self.state = replace(self.state, thumbnails=(*self.state.thumbnails, small_copy))
        posed = Photo(photo.name, photo, Camera(*small, 1.0, 1.0, 0.0, 0.0, np.eye(4)[:3]), mask, upright=True)
        if (kept := kept_pixels(posed, header, True, header.alpha)) is not None:
            cut = self.work / "masks" / f"{name}.png"
            cut.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.where(kept, np.uint8(255), np.uint8(0))).save(cut)
        return size, name

    def _complete_masks(self, copies: Sequence[str]) -> None:
        """Write a white mask for each copy without one: where COLMAP misses a mask it finds no features at all."""
        for name in copies:
            cut = self.work / "masks" / f"{name}.png"
            if not cut.exists():
                cut.parent.mkdir(exist_ok=True)
                with Image.open(self.work / "photos" / name) as copy:
                    Image.new("L", copy.size, 255).save(cut)

    def _stage(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is, with the time that it needs if it goes on as it went."""
        now = time.monotonic()
        if stage != self.state.stage:
            self.begun = now
        spent = now - self.begun
        left = spent * (total - done) / done if done and spent > 1 else None
        self.state = replace(self.state, stage=stage, done=done, total=total, seconds_left=left,
                             photos=len(self.names) or len(self.photos))  # fmt: skip
        self.tell(self.state)

    def ended(self, placed: int) -> None:
        """Show that the search is over, and how many photos have a pose."""
        growing = _growing(self.work / "growing.npz") or self.state.growing
        self.state = replace(self.state, placed=placed, growing=growing)
        self._stage(PLACED, placed, len(self.names))

    # ---- the program

    def run(self) -> dict[str, Any]:
        """Run the program on the task. Returns its result. Raises UserError if it fails or reaches a limit."""
        # -P: this package's files must not be imported as top-level modules
        child = Child([sys.executable, "-P", str(PROGRAM), str(self.work.resolve())])
        try:
            fault = self._follow(child)
        finally:
            child.end()
        result = self.work / "result.json"
        if fault or not result.exists():
            where = f"{self.raw.source}: finding poses failed while {self.state.stage}"
            if shutil.disk_usage(self.work).free < FULL:
                raise UserError(f"{where}: the disk of {self.work.parent} is full: free some space there")
            raise UserError(
                f"{where} ({shorten(fault or 'crash 0', 200)}): look less carefully (fast), or take fewer photos"
            )
        return json.loads(result.read_text("utf-8"))

    def _follow(self, child: Child) -> str:
        """Hear what the program says until it ends; returns its fault."""
        heard = time.monotonic()
        limit = self.options.memory_gb * 1e9 or MEMORY_SHARE * free_memory()
        while (line := child.line(POLL_SECONDS)) is not None:
            if line:
                heard = time.monotonic()
                self._hear(line)
            self.tell(self.state)
            self._check_limits(child.memory(), heard, limit)
        return child.fault()

    def _hear(self, line: bytes) -> None:
        said = json.loads(line)
        if said["stage"] == "poses":
            self.state = replace(
                self.state, placed=max(said["done"], self.state.placed), growing=_growing(self.work / "growing.npz")
            )
        self._stage(STAGES[said["stage"]], said["done"], said["total"])

    def _check_limits(self, used: float, heard: float, limit: float) -> None:
        now, where = time.monotonic(), f"{self.raw.source}: finding poses was stopped while {self.state.stage}"
        if now - self.started > 60 * self.options.minutes:
            raise UserError(
                f"{where}: its {self.options.minutes:g} minutes are over: look less carefully (fast), or raise "
                "the limit with `nerf-core pose --minutes`"
            )
        if now - heard > STALLED and self.state.stage != STAGES["poses"]:
            raise UserError(f"{where}: nothing happened for {duration(STALLED)}: take fewer photos")
        if used > limit:
            raise UserError(
                f"{where}: it took {used / 1e9:.1f} GB of memory, {limit / 1e9:.1f} are allowed: look less "
                "carefully (fast), take fewer photos, or raise the limit with `nerf-core pose --memory-gb`"
            )


def _camera_of(photo: Path) -> tuple[str, int]:
    """What tells the cameras of photos apart: maker and model, and the focal length in 35 mm film; 0: not known."""
    if photo.suffix.lower() in (".exr", ".png", ".bmp"):
        return "", 0
    try:
        with Image.open(photo) as image:
            exif = image.getexif()
            lens = exif.get_ifd(ExifTags.IFD.Exif)
            focal = float(lens.get(ExifTags.Base.FocalLengthIn35mmFilm, 0) or 0)
            names = [str(exif.get(tag, ""))[:100] for tag in (ExifTags.Base.Make, ExifTags.Base.Model)]
            return "/".join(names), round(focal) if 1 <= focal <= 2000 else 0
    except (*BROKEN, AttributeError, ArithmeticError):
        return "", 0  # a damaged tag costs nothing but its focal length


def _growing(file: Path) -> Growing | None:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return Growing(arrays["poses"], arrays["points"], arrays["colors"])
    except (OSError, ValueError, KeyError):
        return None  # not there yet
