"""`nerf-core probe`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import MOVED_HELP, restored
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.geometry.camera_files import picked_camera
from nerf_core.probe.records import WITHOUT_SAMPLES, Opened
from nerf_core.training.run_folder import RunFolder


@COMMANDS.register("probe")
@dataclass(frozen=True)
class Probe:
    """Open a pixel of a run: where its colour comes from, what is wrong with it, what the photos know of it."""

    order: ClassVar[int] = 3

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run folder that `nerf-core train` wrote."""
    camera: str
    """A photo of the capture by its name (test/r_3.png) or its end, or a .json file with a camera, as an opened ray's
    has."""
    pixel: tuple[int, int]
    """Column and row, counted from the top left, in the camera's picture."""
    write: list[Path] = field(default_factory=list)
    """A file to write: .json or .npz with everything, .csv with the samples, .png or .svg with a figure. Repeatable."""
    t: float | None = None
    """Where on the ray the radiance of a point is looked at; by default it is that of the layer that is the surface."""
    axis: Literal["auto", "t", "contracted"] = "auto"
    """Figures are drawn over world distance t, or, for a scene without bounds, over contracted distance."""
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """cpu, cuda, or auto."""

    def run(self, signals: Signals) -> int:
        from nerf_core.probe import open_pixel, write_inspection
        from nerf_core.probe.report import check_format

        for file in self.write:
            check_format(file)
        trainer = restored(RunFolder(self.run_folder), self.data, self.device)
        camera = picked_camera(trainer.scene, self.camera)
        try:
            opened = open_pixel(
                trainer.method, trainer.scene, camera, self.pixel, trainer.step_count, self.t,
                exposures=trainer.exposures,
            )  # fmt: skip
        except UserError as error:  # it begins with the name of what is wrong: pixel, t
            raise UserError(f"--{error}") from None
        for line in _lines(opened):
            say(line)
        for file in self.write:
            write_inspection([opened], file, self.axis)
            say(f"wrote {file}")
        return 0


def _lines(opened: Opened) -> list[str]:
    ray, verdict = opened.ray, opened.verdict
    what = WITHOUT_SAMPLES if verdict is None else f"{verdict.kind}: {'; '.join(verdict.reasons)}"
    name, t = ("median depth", ray.depth_median) if ray.passes else ("depth", ray.depth_expected)
    color = ", ".join(f"{v:.3f}" for v in ray.color)
    depth = "none" if t is None else f"{t:.4g}"
    lines = [what, f"colour {color}; opacity {ray.opacity:.3f}; {name} {depth}; step {ray.step:,}"]
    if len(ray.visited):
        lines.append(f"visited, one after another, t = {', '.join(f'{place:.4g}' for place in ray.visited)}")
    return lines
