"""`nerf-core render`."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import MOVED_HELP, finished, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.common.text import counted
from nerf_core.geometry.paths import DEFAULT_PATH, PATHS
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.training.run_folder import RunFolder


def described(values: dict[str, str]) -> str:
    """ "60 (orbit), 120 (spiral)": each path's value with its name."""
    return ", ".join(f"{value} ({name})" for name, value in values.items())


KINDS = {name: PATHS.get(name) for name in PATHS.names()}
FRAMES = described({name: str(kind.default_frames or "all") for name, kind in KINDS.items()})
OPTIONS = {name: option for kind in KINDS.values() for name, option in kind.options.items()}
# A field for each option that a kind of path has: a new kind brings its own.
PathOptions = make_dataclass(
    "PathOptions",
    [
        (name, Annotated[float | None, tyro.conf.arg(help=option.help)], field(default=None, kw_only=True))
        for name, option in OPTIONS.items()
    ],
    frozen=True,
)


@COMMANDS.register("render")
@dataclass(frozen=True)
class Render(PathOptions):
    """Render a camera path of a trained run to an MP4."""

    order: ClassVar[int] = 2

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help="A run folder.")]
    out: Path
    """The .mp4 file."""
    path: Annotated[
        str,
        tyro.conf.arg(
            metavar="{" + ",".join(KINDS) + "}", help=described({name: kind.summary for name, kind in KINDS.items()})
        ),
    ] = DEFAULT_PATH
    frames: Annotated[int | None, tyro.conf.arg(help=f"Number of frames; by default {FRAMES}.")] = None
    fps: float = 30.0
    """Frames a second."""
    width: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    height: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    png_frames: bool = False
    """Also write every frame as a PNG, beside the video."""
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    def run(self, signals: Signals) -> int:
        for name, most in (("frames", 100_000), ("width", 16_384), ("height", 16_384)):
            if not 1 <= (getattr(self, name) or 1) <= most:
                raise UserError(f"--{name} {shorten(getattr(self, name))}: give a whole number from 1 to {most:,}")
        if self.out.suffix.lower() != ".mp4":
            raise UserError(f"--out {self.out}: only MP4 is written: name a .mp4 file")
        kind = PATHS.get(self.path)
        chosen: dict[str, Any] = {name: getattr(self, name) for name in OPTIONS if getattr(self, name) is not None}
        for name in chosen.keys() - kind.options.keys():
            owners = " and ".join(owner for owner, other in KINDS.items() if name in other.options)
            raise UserError(f"--{name} belongs to --path {owners}, not to {self.path}: leave it out")
        trainer = restored(RunFolder(self.run_folder), self.data, self.device)
        cameras = kind.cameras(trainer.scene, self.frames, self.width, self.height, **chosen)
        signals.be_polite()
        job = FilmJob(trainer.method, trainer.scene, ExportPath(cameras, self.fps, self.out, self.png_frames))
        finished(job, signals, "rendering", counted(len(cameras), "frame"))
        say(f"wrote {self.out}: {counted(len(cameras), 'frame')}")
        return 0
