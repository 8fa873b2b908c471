"""The study that runs beside the models of a window."""

from __future__ import annotations

import traceback
from collections.abc import Callable

from nerf_core.common.configs import changed
from nerf_core.common.device import enough_memory
from nerf_core.common.errors import UserError
from nerf_core.common.language import phrase
from nerf_core.common.user_paths import absolute
from nerf_core.lab.job import StudyJob, summary
from nerf_core.lab.records import StudyState
from nerf_core.lab.study import STUDIES, Subject
from nerf_core.live.messages import CancelStudy, Notice, StartStudy, TurnKnob
from nerf_core.live.run import Run

STUDY_RUN = 0  # its number for the scheduler; runs are numbered from 1


class Studies:
    """At most one at a time, done a piece at a time. Owned by the worker thread.

    Args:
        tell: takes a notice.

    Attributes:
        number: for the scheduler.
        newest: the progress of the newest study; None: there was none.
    """

    number = STUDY_RUN

    def __init__(self, tell: Callable[[Notice], None]) -> None:
        self.newest: StudyState | None = None
        self._tell = tell
        self._job: StudyJob | None = None
        self._command = 0  # the number of the command that began it

    @property
    def training(self) -> bool:
        """Whether a study runs: the scheduler then gives it its share of the training time."""
        return self._job is not None

    def obey(self, command: StartStudy | CancelStudy | TurnKnob, run: Run, number: int) -> None:
        """Do what a command asks for. Raises UserError if that is impossible.

        run: whose scene a study is about. number: of the command, for answers that come later.
        """
        match command:
            case StartStudy():
                self.start(command, run, number)
            case CancelStudy():
                self.cancel()
            case TurnKnob(knob, value):
                self.turn(knob, value)

    def start(self, asked: StartStudy, run: Run, command: int) -> None:
        """Begin a study of the scene of a run, or of a photo.

        Raises UserError if another one runs, for options that do not fit, and if the folder cannot be used.
        """
        if self._job is not None:
            raise UserError(f"the study {self._job.name} runs: cancel it or wait for it")
        kind = STUDIES.get(asked.name)
        try:
            study = changed(kind(), asked.options, asked.name)
        except UserError as error:
            raise UserError(str(error).replace("--set ", "", 1)) from None
        if kind.of_scene:
            subject = Subject(run.capture, run.settings.load, run.need_scene(), run.settings.device)
        else:
            subject = Subject(asked.photo, run.settings.load, None, run.settings.device)
        self._job = StudyJob(study, subject, absolute(asked.folder), watched=True)
        self.newest, self._command = self._job.progress, command

    def turn(self, knob: str, value: float) -> None:
        """Raises UserError if no study runs that has this knob."""
        if self._job is None or self._job.cancelled:
            raise UserError("no study runs: start one first")
        self._job.turn(knob, value)
        self.newest = self._job.progress

    def cancel(self) -> None:
        """Stop the study; its folder keeps what is done."""
        if self._job is not None:
            self._job.cancel()
            self._take(self._job)

    def advance(self, tick: Callable[[], None]) -> None:
        """Do one piece. What goes wrong is told, and the study has then failed."""
        job = self._job
        if job is None:
            return
        try:
            with enough_memory():
                job.advance(tick)
        except UserError as error:
            text = phrase("the study failed: {error}", error=str(error))
            self._tell(Notice("error", text, kind="failed", command=self._command))
        except Exception as error:  # a fault of the study is none of the open models
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            text = phrase("the study failed: {error}", error=reason)
            detail = traceback.format_exc()
            self._tell(Notice("error", text, detail=detail, kind="failed", command=self._command))
        self._take(job)
        if job.progress.state == "done":
            text = phrase("study {name}: {summary}", name=job.name, summary=summary(job))
            self._tell(Notice("info", text, job.progress.files[0], kind="studied", command=self._command))

    def _take(self, job: StudyJob) -> None:
        self.newest = job.progress
        if job.progress.state != "running":
            self._job = None
