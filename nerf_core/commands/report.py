"""`nerf-core report`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from nerf_core.captures.opening import open_capture
from nerf_core.captures.report import capture_report
from nerf_core.captures.report_html import check_files, write_report
from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import loading
from nerf_core.common.console import Display
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.common.user_paths import absolute
from nerf_core.training.options import LoadingOptions


@COMMANDS.register("report")
@dataclass(frozen=True)
class Report:
    """Check the photos of a capture before training: what limits the quality, and what to photograph next."""

    order: ClassVar[int] = 8

    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DATA]")] = None
    """Folder of the capture (or its .json file), or photos without poses, which are found first; none: the demo
    scene."""
    out: Path | None = None
    """The page, a .html file; its numbers go into a .json file beside it. By default SCENE-report.html in the current
    folder. Earlier reports of the name are replaced, other files are not."""
    load: Annotated[LoadingOptions, tyro.conf.arg(name="")] = field(default_factory=LoadingOptions)

    def run(self, signals: Signals) -> int:
        options = self.load.loading()
        if self.out is not None:
            check_files(self.out)  # before the photos are loaded
        with loading() as progress:
            scene = open_capture(self.data, options, progress)
        file = self.out or Path(f"{scene.name or 'capture'}-report.html")
        if self.out is None:
            _must_be_outside(self.data)
        check_files(file)
        with Display("checking") as display:

            def show(words: str, done: int, total: int) -> None:
                display.show(done / total, f"{words}: {done:,} of {total:,}")

            report = capture_report(scene, progress=show)
        say(report.overall)
        say(report.summary)
        for k, limit in enumerate(report.limits, 1):
            say(f"{k}. {limit.text} → {limit.advice}")
        if not report.limits:
            say("no limit was found")
        for text in report.next:
            say(f"to photograph next: {text}")
        for written in write_report(report, file):
            say(f"wrote {written}")
        return 0


def _must_be_outside(data: Path | None) -> None:
    """Raise UserError if the current folder belongs to the capture: nothing is written there unless it is asked for."""
    if data is None:
        return
    capture = absolute(data).resolve()
    folder, here = (capture if capture.is_dir() else capture.parent), Path.cwd().resolve()
    if folder == here or folder in here.parents:
        raise UserError("the current folder belongs to the capture: name the page with --out")
