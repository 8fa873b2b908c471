"""Train a run folder to its goal: steps, log lines, checkpoints, and a stop that loses nothing."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nerf_core.common import device
from nerf_core.common.errors import UserError
from nerf_core.methods.group import Lost
from nerf_core.training import checkpoint
from nerf_core.training.autosaves import left_off, spare_files
from nerf_core.training.checkpoint import step_path
from nerf_core.training.last_good import LastGood
from nerf_core.training.last_save import save_somewhere, telling
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Diverged, Report, Trainer, nothing, psnr_of

LOG_SECONDS = 1.0  # between two lines of the log
SHOW_SECONDS = 0.1  # between two calls of `show`
MEMORY = 0.98  # decay of the EMA of what is shown, per step: it averages some 50 steps
COMPARE_EVERY = 100  # steps between comparisons of the weights that the processes of a group have
GO_ON, STOP, END = range(3)  # what a process wants before a step; the greatest wish of a group is done


@dataclass(frozen=True)
class Goal:
    """When training ends: at a step or after a time, whichever comes first. Both count from the run's beginning.

    steps: the step.
    seconds: seconds of training steps alone.
    """

    steps: int
    seconds: float = math.inf

    def reached(self, trainer: Trainer) -> bool:
        """Return whether the trainer is at the goal."""
        return trainer.step_count >= self.steps or trainer.seconds >= self.seconds


@dataclass(frozen=True)
class Progress:
    """The progress of training.

    step: the number of steps done.
    psnr: in dB, of the mean loss of the last some 50 batches.
    rays_per_second: over the same steps.
    seconds: seconds of training steps alone, since the run's beginning.
    seconds_left: an estimate of the seconds to the goal.
    fraction: the share of the goal that is done, in [0, 1].
    """

    step: int
    psnr: float
    rays_per_second: float
    seconds: float
    seconds_left: float
    fraction: float


class _StoppedError(Exception):
    """`stop` returned True between two gradient chunks."""


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
    """Train to a goal, and write checkpoints and log lines into a run folder.

    Args:
        run: the folder. The caller holds it with `claimed()`.
        trainer: what to train.
        goal: when training ends.
        save_every: seconds of training between checkpoints. One is written at the end in any case.
        stop: asked between gradient chunks. If it returns True, the step under way is abandoned and the run is saved
            as it was before that step.
        show: called with the progress, about ten times a second.
        warn: called with a text for the user, and training continues: a checkpoint or log line cannot be written, a
            step has a note, or the last checkpoint went to another place because the folder cannot be written.

    Returns:
        True if the goal was reached, False if `stop` ended training.

    Raises:
        Diverged: loss or weights are not finite.
        UserError: device memory ran out, or no place takes the last checkpoint.
        Other errors of a step are passed on. In all these cases the last good state is saved before, if that is
        possible, and `trainer` cannot be used any more.
    """
    return _Session(run, trainer, goal, save_every, stop, show, warn).run()


def train_steps(
    trainer: Trainer,
    reached: Callable[[], bool],
    stop: Callable[[], bool],
    after: Callable[[Report], None] = lambda report: None,
) -> bool:
    """Make steps until the first process has reached the goal or any process of the group is stopped.

    Args:
        trainer: what to train.
        reached: whether the goal is reached, asked between steps.
        stop: asked between gradient chunks, of several processes only between steps, where they agree on it.
        after: called after each step.

    Returns:
        True if the goal was reached, False if training was stopped.
    """
    group = trainer.group

    def between_chunks() -> None:
        if stop():
            raise _StoppedError

    try:
        while True:
            wish = group.greatest(END if reached() else STOP if stop() else GO_ON)
            if wish != GO_ON:
                return wish == END
            after(trainer.step(between_chunks if group.size == 1 else nothing))
            if trainer.step_count % COMPARE_EVERY == 0:
                trainer.compare()
    except _StoppedError:
        return False


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
        self._told = ""  # the last warning about a file that cannot be written

    def run(self) -> bool:
        try:
            finished = train_steps(self.trainer, lambda: self.goal.reached(self.trainer), self.stop, self._after)
            self._good.remember(self.trainer)
        except Exception as error:
            if isinstance(error, Lost):  # raised between steps or before the weights changed
                with suppress(Diverged):
                    self._good.remember(self.trainer)
            self._save_last(asked=False)
            step = self._good.description["step"]
            if isinstance(error, Diverged):
                raise Diverged(f"{error}; went back to step {step:,} and saved it") from None
            if isinstance(error, Lost):
                raise Lost(f"{error}; step {step:,} is saved") from None
            if isinstance(error, torch.OutOfMemoryError):
                raise UserError(
                    f"out of memory on {device.describe(self.trainer.device)}; step {step:,} is saved: "
                    "use a smaller step: --set rays, samples or chunk_rays"
                ) from error
            raise
        self._log()
        self._save_last(asked=not finished)
        return finished

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

    def _save(self) -> Path:
        return self.folder.save(self._good.description, self._good.state)

    def _save_last(self, *, asked: bool) -> None:
        """Save, in another place if the run's folder cannot be written. Raises UserError.

        asked: whether `stop` ended training.
        """
        good, own = self._good, step_path(self.folder.path, self._good.description["step"])

        def write(file: Path) -> Path:
            if file == own:
                return self._save()
            return checkpoint.save(file, {**good.description, **self._left_off(file)}, good.state)

        with telling(good.description["step"], self.warn, asked=asked):
            file, reasons = save_somewhere([own, *spare_files(self.trainer.scene)], write)
        for reason in reasons:
            self.warn(reason)
        if reasons:
            self.warn(f"step {good.description['step']:,} is saved to {file}: move it to {own}, to continue the run")

    def _left_off(self, file: Path) -> dict[str, Any]:
        try:
            data, settings = self.folder.config()
        except UserError:  # weights are worth more than where their capture is
            return {}
        return left_off(file, data, settings.load)

    def _log(self) -> None:
        line = self._meter.line(self.trainer)
        if line is not None:
            self._tolerate(lambda: self.folder.log(line))

    def _tolerate(self, write: Callable[[], object]) -> None:
        try:
            write()
        except UserError as error:
            if str(error) != self._told:  # a full disk would be told of at every second's log line
                self._told = str(error)
                self.warn(self._told)

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
    """Averages over steps: an EMA for what is shown, and for the log the mean since its last line."""

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
        """Return the next line of the log; None if there was no step since the last line."""
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
