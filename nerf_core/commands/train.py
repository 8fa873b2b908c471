"""`nerf-core train`."""

from __future__ import annotations

import os
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from nerf_core.captures.opening import open_capture
from nerf_core.captures.raw_photos import raw_photos
from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import loading, restored, tell, warn
from nerf_core.common.console import Display
from nerf_core.common.device import describe, pick_device
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.processes import started_together
from nerf_core.common.signals import Signals
from nerf_core.common.text import counted, duration
from nerf_core.datasets.images import damage_notes
from nerf_core.kernels import choice as kernels
from nerf_core.methods import nothing_to_train
from nerf_core.methods.group import ALONE, Group
from nerf_core.training.checkpoint import step_path
from nerf_core.training.loop import Progress, train_run, train_steps
from nerf_core.training.options import TrainOptions, run_name
from nerf_core.training.run_folder import RunFolder, must_agree
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer, check_constants, choose_method, must_be_distributed

DATA_HELP = "Folder of the capture (or its .json, .xml or .csv file); none: the demo scene."


@COMMANDS.register("train")
@dataclass(frozen=True)
class Train:
    """Train a scene into a run folder. Ctrl-C or SIGTERM saves and ends; --resume then continues. Under torchrun
    several processes train it together."""

    order: ClassVar[int] = 0

    training: TrainOptions
    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DATA]", help=DATA_HELP)] = None
    out: Path | None = None
    """The run folder; by default runs/SCENE-METHOD."""
    resume: bool = False
    """Continue the run in --out with its own data, options and schedule; --steps and --seconds still say when it
    ends, counted from its beginning."""
    save_every: float = 60.0
    """Seconds of training between checkpoints; the newest two are kept."""

    def run(self, signals: Signals) -> int:
        settings = self.training.settings()
        if not self.save_every > 0:
            raise UserError(f"--save-every {self.save_every}: give a number above 0")
        with _group(settings.device) as group:
            return self._run(settings, group, signals)

    def _run(self, settings: RunSettings, group: Group, signals: Signals) -> int:
        device = group.device or settings.device
        method, _ = choose_method(settings.method, pick_device(device))
        run, first = RunFolder(self.out or Path("runs") / run_name(self.data, method)), group.rank == 0
        if self.resume:
            must_agree(settings, run)
            method = run.config()[1].method
        else:
            check_constants(settings)  # before poses are searched for
        if first and not self.resume:
            self._must_be_free(run, settings)
        if group.size > 1:
            must_be_distributed(method)  # before the photos are loaded
        began = time.monotonic()
        with run.claimed() if first else nullcontext():
            if self.resume:
                trainer = restored(run, self.data, device, group)
                trainer.compare()  # all have read the checkpoint before the folder changes
                tell(run.rewind(trainer.step_count) if first else ())
                say(f"continuing {run.path} at step {trainer.step_count:,}")
            else:
                if first:
                    run.must_be_new()
                with loading() as progress:
                    scene = open_capture(self.data, settings.load, progress)
                tell(scene.notes)
                trainer = Trainer(scene, replace(settings, device=device), group)
                trainer.compare()
                tell([note for note in (kernels.note(trainer.device),) if note])
                if first:
                    run.begin(self.data, settings, trainer)
            return self._train(run, trainer, signals, time.monotonic() - began)

    def _must_be_free(self, run: RunFolder, settings: RunSettings) -> None:
        """Raise UserError if --out has to do with the photos' folder, or holds something and is no run folder."""
        raw = raw_photos(self.data) if settings.load.format == "auto" else None
        if self.out is not None and raw is not None and raw.meets(self.out):
            raise UserError(f"{self.out} holds the photos or lies among them: choose another --out")
        if run.checkpoints() or not run.path.is_dir():
            return
        run.must_be_new()
        try:
            foreign = set(os.listdir(run.path)) - {".lock", "checkpoints"}  # of a training that has just begun
        except OSError as error:
            raise UserError(f"{run.path}: cannot be read ({error.strerror or error}): choose another --out") from None
        if foreign and not run.config_file.exists():
            raise UserError(f"{run.path} is not empty and holds no run: choose another --out")

    def _train(self, run: RunFolder, trainer: Trainer, signals: Signals, loading: float) -> int:
        if not trainer.total_steps:
            saved = run.save(trainer.describe(), trainer.state())  # what eval, render and probe load
            say(f"{nothing_to_train(trainer.method_name)}; saved {saved}")
            return 0
        goal = self.training.goal(trainer.total_steps)
        if goal.reached(trainer):
            say(f"nothing to do: {_summary(trainer)}; --steps and --seconds count from the beginning of the run")
            return 0
        signals.be_polite()
        views = len(trainer.scene.split("train"))
        say(
            f"training {trainer.method_name}{f' ({trainer.reason})' if trainer.reason else ''} on {trainer.scene.name} "
            f"({counted(views, 'photo')}), {describe(trainer.device)}"
            f"{f', {trainer.group.size} processes' if trainer.group.size > 1 else ''}"
        )

        if self.training.steps is None and self.training.seconds is None:
            say(f"no --steps and no --seconds: all {trainer.total_steps:,} steps follow; Ctrl-C ends and saves")

        def stop() -> bool:
            return signals.received is not None

        with Display("training") as display:

            def show(p: Progress) -> None:
                text = f"step {p.step:,}, {p.rays_per_second:,.0f} rays/s, {p.psnr:.2f} dB"
                text += f"; {trainer.method.stage}" if trainer.method.stage else ""
                display.show(p.fraction, text, p.seconds_left)

            if trainer.group.rank == 0:
                finished = train_run(run, trainer, goal, save_every=self.save_every, show=show, warn=warn, stop=stop)
            else:
                finished = train_steps(trainer, lambda: False, stop)
        if (filling := trainer.scene.photos.filling) is not None:
            tell(damage_notes(filling.damaged()))
        ending = "finished" if finished else "stopped"
        saved = step_path(run.path, trainer.step_count)
        where = f"; saved {saved}" if saved.exists() else ""  # else a warning said where it is
        say(f"{ending}: {_summary(trainer)}; loading took {duration(loading)}{where}")
        if trainer.corrections is not None:
            say(f"poses: {trainer.corrections.summary()}")
        return 0 if finished else 128 + trainer.group.greatest(signals.received or 0)


def _group(device: str) -> AbstractContextManager[Group]:
    """The processes that torchrun started; without torchrun this one alone."""
    if not started_together():
        return nullcontext(ALONE)
    from nerf_core.training.distributed import together

    return together(device)


def _summary(trainer: Trainer) -> str:
    text = f"step {trainer.step_count:,} after {duration(trainer.seconds)} of training"
    return f"{text} ({trainer.method.stage})" if trainer.method.stage else text
