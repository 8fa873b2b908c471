"""Training a run folder to its goal: steps, log lines, checkpoints, and a way out that loses nothing."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from nerf_core.common import device
from nerf_core.common.errors import UserError
from nerf_core.training.last_good import LastGood
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Diverged, Report, Trainer, psnr_of

LOG_SECONDS = 1.0
SHOW_SECONDS = 0.1
MEMORY = 0.98  # the share of the average that a step leaves: figures on show are means over some 50 steps


@dataclass(frozen=True)
class Goal:
    """Until step `steps` or `seconds` of training, whichever comes first; both counted from the run's beginning."""

    steps: int
    seconds: float = math.inf

    def reached(self, trainer: Trainer) -> bool:
        return trainer.step_count >= self.steps or trainer.seconds >= self.seconds


@dataclass(frozen=True)
class Progress:
    """Training so far: psnr in dB of the last batches' mean loss, seconds of training alone, fraction of the goal."""

    step: int
    psnr: float
    rays_per_second: float
    seconds: float
    seconds_left: float
    fraction: float


class _StoppedError(Exception):
    """Somebody asked to stop between two gradient chunks."""


def train_run(
    run: RunFolder,
    trainer: Trainer,
    goal: Goal,
    *,
    save_every: float = 60.0,
    stop: Callable[[], bool] = lambda: False,
    show: Callable[[Progress], None] = lambda progress: None,
    warn: Callable[[str], None] = lambda text: None,
) -> bool:
    """Train and save into a claimed `run`; whether the goal was reached, or else `stop()` was true.

    save_every: seconds of training between checkpoints; one is written at the end in any case. `stop` is asked
    between gradient chunks; the step under way is then given up and the run saved as it was before it. A periodic
    checkpoint or log line that cannot be written is told to `warn`, and training goes on.
    Raises Diverged or whatever else broke a step, after saving the last good state; `trainer` is then of no use.
    Raises UserError when the last checkpoint cannot be written.
    """
    return _Session(run, trainer, goal, save_every, stop, show, warn).run()


@dataclass
class _Session:
    folder: RunFolder
    trainer: Trainer
    goal: Goal
    save_every: float
    stop: Callable[[], bool]
    show: Callable[[Progress], None]
    warn: Callable[[str], None]

    def __post_init__(self) -> None:
        self._meter = _Meter()
        self._logged = self._shown = time.monotonic()
        self._saved_seconds = self.trainer.seconds
        self._good = LastGood(self.trainer)

    def run(self) -> bool:
        try:
            finished = self._train()
            self._good.remember(self.trainer)
        except Exception as error:
            self._save()
            step = self._good.description["step"]
            if isinstance(error, Diverged):
                raise Diverged(f"{error}; went back to step {step:,} and saved it") from None
            if isinstance(error, torch.OutOfMemoryError):
                raise UserError(
                    f"out of memory on {device.describe(self.trainer.device)}; step {step:,} is saved: "
                    "use a smaller step: --set rays, samples or chunk_rays"
                ) from error
            raise
        self._log()
        self._save()
        return finished

    def _train(self) -> bool:
        """Train until the goal is reached. Returns False if training was stopped before."""
        try:
            while not self.goal.reached(self.trainer):
                self._between_chunks()
                self._after(self.trainer.step(self._between_chunks))
        except _StoppedError:
            return False
        return True

    def _between_chunks(self) -> None:
        if self.stop():
            raise _StoppedError

    def _after(self, report: Report) -> None:
        self._meter.add(report)
        if report.note:
            self.warn(report.note)
        now = time.monotonic()
        if now - self._shown >= SHOW_SECONDS:
            self._shown = now
            self.show(self._progress())
        if now - self._logged >= LOG_SECONDS:
            self._logged = now
            self._log()
        if self.trainer.seconds - self._saved_seconds >= self.save_every:
            self._saved_seconds = self.trainer.seconds
            self._good.remember(self.trainer)
            self._tolerate(self._save)
        elif self._good.due():
            self._good.remember(self.trainer)

    def _save(self) -> None:
        self.folder.save(self._good.description, self._good.state)

    def _log(self) -> None:
        line = self._meter.line(self.trainer)
        if line is not None:
            self._tolerate(lambda: self.folder.log(line))

    def _tolerate(self, write: Callable[[], object]) -> None:
        try:
            write()
        except UserError as error:
            self.warn(str(error))

    def _progress(self) -> Progress:
        trainer, goal, meter = self.trainer, self.goal, self._meter
        left = (goal.steps - trainer.step_count) * meter.seconds_per_step
        return Progress(
            step=trainer.step_count,
            psnr=psnr_of(meter.loss),
            rays_per_second=meter.rays_per_second,
            seconds=trainer.seconds,
            seconds_left=min(left, goal.seconds - trainer.seconds),
            fraction=min(1.0, max(trainer.step_count / goal.steps, trainer.seconds / goal.seconds)),
        )


class _Meter:
    """Figures for the eye (averages that forget) and for the log (plain means since its last line)."""

    def __init__(self) -> None:
        self._weight = self._loss = self._rays = self._seconds = 0.0
        self._since: list[Report] = []

    def add(self, report: Report) -> None:
        self._since.append(report)
        self._weight = self._weight * MEMORY + 1
        self._loss = self._loss * MEMORY + report.loss
        self._rays = self._rays * MEMORY + report.rays
        self._seconds = self._seconds * MEMORY + report.seconds

    @property
    def loss(self) -> float:
        return self._loss / self._weight

    @property
    def rays_per_second(self) -> float:
        return self._rays / self._seconds

    @property
    def seconds_per_step(self) -> float:
        return self._seconds / self._weight

    def line(self, trainer: Trainer) -> dict[str, float] | None:
        """The next line of the log, or None if there was no step since the last."""
        reports, self._since = self._since, []
        if not reports:
            return None
        loss = sum(r.loss for r in reports) / len(reports)
        return {
            "step": reports[-1].step,
            "loss": loss,
            "psnr": psnr_of(loss),
            "rays_per_second": sum(r.rays for r in reports) / sum(r.seconds for r in reports),
            "seconds": trainer.seconds,
        }
