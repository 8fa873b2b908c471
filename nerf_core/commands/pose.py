"""`nerf-core pose`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from nerf_core.captures.posing import find_poses
from nerf_core.captures.raw_photos import RawPhotos, is_capture, raw_photos
from nerf_core.captures.records import PoseOptions, PoseProgress
from nerf_core.commands import COMMANDS
from nerf_core.common.console import Display
from nerf_core.common.errors import UserError
from nerf_core.common.output import complain, say
from nerf_core.common.signals import Signals
from nerf_core.common.text import duration
from nerf_core.common.user_paths import own_path
from nerf_core.datasets.capture import PoseLens, Quality
from nerf_core.datasets.images import SUFFIXES
from nerf_core.datasets.recognise import without_photos


@COMMANDS.register("pose")
@dataclass(frozen=True)
class Pose:
    """Find the poses of photos or of a video's frames (structure from motion), as a COLMAP folder."""

    order: ClassVar[int] = 7

    photos: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS", help="A folder of photos or a video.")
    ]
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where the result goes; by default into the cache, where the window and `nerf-core train` look for it."""
    quality: Quality = "normal"
    """fast takes a third of the time; high doubles the photos to find more points."""
    lens: PoseLens = "perspective"
    """fisheye: of action cameras and lenses that bend straight lines a lot; 360° panoramas are not placed."""
    frames: int = 0
    """How many frames of a video are taken; 0 chooses by its length."""
    minutes: float = 120.0
    """The time limit."""
    memory_gb: float = 0.0
    """The memory limit; 0: three quarters of what is free."""

    def run(self, signals: Signals) -> int:
        source = own_path(self.photos)
        if not source.exists():
            raise UserError(f"{self.photos} does not exist: name a folder of photos, or a video")
        raw = raw_photos(source)
        if raw is None:
            raise UserError(f"{self.photos} {_lacks(source)}: name a folder of photos, or a video")
        signals.be_polite()
        options = PoseOptions(self.quality, self.frames, self.minutes, self.memory_gb, self.lens)
        with Display("finding poses") as display:

            def show(state: PoseProgress) -> None:
                signals.check()
                words = f"{state.stage}: {state.done:,} of {state.total:,}"
                words += f", {state.placed:,} placed" if state.placed and state.placed != state.done else ""
                display.show(None, words, state.seconds_left)

            posed = find_poses(raw, None if self.out is None else own_path(self.out), options, show)
        for name, why in posed.unplaced:
            complain(f"without a pose: {name}: {why}")
        if posed.advice:
            complain(posed.advice)
        found = "found again" if posed.again else f"found in {duration(posed.seconds)}"
        say(f"{posed.summary}; {found}")
        say(f"wrote {posed.folder}")
        say(f"next: nerf-viewer {self._opens(raw, posed.folder)}")
        return 0

    def _opens(self, raw: RawPhotos, folder: Path) -> str:
        """The arguments with which the window opens the poses: their folder, or the photos if it finds them again."""
        if self.out is not None or (raw.video is not None and self.frames):
            return shlex.quote(str(folder))
        words = [shlex.quote(str(self.photos))]
        words += [] if self.quality == "normal" else ["--poses", self.quality]
        words += [] if self.lens == "perspective" else ["--lens", self.lens]
        return " ".join(words)


def _lacks(source: Path) -> str:
    """Why no poses are searched for."""
    if source.is_file():
        return "is one photo" if source.suffix.lower() in SUFFIXES else "is no video"
    return "has poses already" if is_capture(source) else without_photos(source)
