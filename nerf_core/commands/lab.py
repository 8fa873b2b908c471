"""`nerf-core lab`: the lecture's studies."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Union

import tyro

from nerf_core.captures.opening import open_capture
from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import loading, tell
from nerf_core.common.configs import constants
from nerf_core.common.console import Display
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.signals import Interrupted, Signals
from nerf_core.datasets import LoadOptions
from nerf_core.lab.job import StudyJob, failure, summary
from nerf_core.lab.study import STUDIES, Subject, takes_photo
from nerf_core.lab.workers import rows_on
from nerf_core.training.options import LoadingOptions, run_name

SCENE_HELP = "Folder of the capture (or its .json, .xml or .csv file); none: the demo scene."
PHOTO_HELP = "A photo; none: a picture that the program draws."


@dataclass(frozen=True)
class Common:
    """What every study has on the command line."""

    out: Path | None = None
    """The folder of the study; by default lab/SCENE-STUDY. A study that was interrupted goes on there."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    workers: str = ""
    """Do the rows as tasks of a Ray cluster, ray://HOST:PORT; needs the extra nerf-viewer[ray]."""


def _options(name: str) -> Any:
    """Return the dataclass of a study's command line: what it is about, its constants, and `Common`."""
    study = STUDIES.get(name)
    shown, text = ("[DATA]", SCENE_HELP) if study.of_scene else ("[PHOTO]", PHOTO_HELP)
    about = Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar=shown, help=text)]
    data = [("data", about, None)] if study.of_scene or takes_photo(study) else []
    own = [
        (key, Annotated[type(default), tyro.conf.arg(help=f"{one.help[0].upper()}{one.help[1:]}.")], default)
        for key, (default, one) in constants(study).items()
    ]
    load = [("load", LoadingOptions, field(default_factory=LoadingOptions))] if study.of_scene else []
    made = make_dataclass(f"Lab{study.__name__}", [*data, *own, *load], bases=(Common,), frozen=True)
    made.__doc__ = study.__doc__
    return Annotated[made, tyro.conf.subcommand(name)]


_NAMES = sorted(STUDIES.names(), key=lambda name: STUDIES.get(name).order)
_STUDIES: Any = Union[tuple(_options(name) for name in _NAMES)]  # noqa: UP007  (a number of them)


@COMMANDS.register("lab")
@dataclass(frozen=True)
class Lab:
    """Studies of the lecture's claims: each trains and measures rows, and writes a report with tables and figures."""

    order: ClassVar[int] = 4

    if TYPE_CHECKING:
        study: Any
    else:
        study: _STUDIES
        """Which one."""

    def run(self, signals: Signals) -> int:
        given: Any = self.study
        name = next(n for n in _NAMES if type(given).__name__ == f"Lab{STUDIES.get(n).__name__}")
        kind = STUDIES.get(name)
        study = kind(**{key: getattr(given, key) for key in constants(kind)})
        run_rows = rows_on(given.workers) if given.workers else None
        scene, load, data = None, LoadOptions(), getattr(given, "data", None)
        if kind.of_scene:
            load = given.load.loading()
            with loading() as progress:
                scene = open_capture(data, load, progress)
            tell(scene.notes)
        subject = Subject(data, load, scene, given.device)
        folder = given.out or Path("lab") / (run_name(data, name) if kind.of_scene or data else name)
        job = StudyJob(study, subject, folder, run_rows)
        signals.be_polite()
        try:
            self._work(job, signals)
        except Interrupted:
            job.cancel()
            say(f"what is done stays in {folder}: the same command goes on from there")
            raise
        finally:
            job.cancel()
        for table in job.progress.tables:
            for line in table.plain().splitlines():
                say(line)
        if failure(job):
            raise UserError(f"no row could be done: {failure(job)}")
        say(summary(job))
        return 0

    def _work(self, job: StudyJob, signals: Signals) -> None:
        with Display(job.name) as display:
            while job.advance():
                signals.check()
                progress = job.progress
                display.show(progress.fraction, progress.text, progress.seconds_left)
