"""`nerf-core render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import MOVED_HELP, restored
from nerf_core.common.console import Display
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.signals import Signals
from nerf_core.geometry.paths import PATHS
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.training.run_folder import RunFolder


@COMMANDS.register("render")
@dataclass(frozen=True)
class Render:
    """Render a camera path of a trained run to an MP4."""

    order: ClassVar[int] = 2

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help="A run folder.")]
    out: Path
    """The .mp4 file."""
    path: Literal["orbit", "spiral", "test"] = "orbit"
    """Around the scene, a spiral before it, or through the held-out views."""
    frames: int | None = None
    """Number of frames; by default 60 (orbit), 120 (spiral), all (test)."""
    fps: float = 30.0
    """Frames a second."""
    width: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    height: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    elevation: float | None = None
    """Of an orbit, degrees above the horizon; by default 25."""
    radius: float | None = None
    """Of an orbit, in scene units; by default the cameras' own distance."""
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
        around = {"elevation_degrees": self.elevation, "radius": self.radius}
        chosen: dict[str, Any] = {name: value for name, value in around.items() if value is not None}
        if chosen and self.path != "orbit":
            raise UserError(f"--elevation and --radius belong to --path orbit, not to {self.path}: leave them out")
        trainer = restored(RunFolder(self.run_folder), self.data, self.device)
        cameras = PATHS[self.path](trainer.scene, self.frames, self.width, self.height, **chosen)
        signals.be_polite()
        job = FilmJob(trainer.method, trainer.scene, ExportPath(cameras, self.fps, self.out, self.png_frames))
        try:
            with Display("rendering") as display:
                while job.advance():
                    signals.check()
                    p = job.progress
                    display.show(p.done / p.total, f"{len(cameras)} frames", p.seconds_left)
        finally:
            job.abort()  # of a finished video: does nothing
        print(f"wrote {self.out}: {len(cameras)} frames")
        return 0
