"""The check of a capture's photos that runs beside the models of a window."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_core.captures.report import checking
from nerf_core.captures.report_html import write_report
from nerf_core.captures.report_records import CaptureReport, ReportState
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase
from nerf_core.common.user_paths import absolute
from nerf_core.live.messages import CancelReport, Notice, StartReport, WriteReport

if TYPE_CHECKING:
    from nerf_core.live.run import Run

REPORT_RUN = -1  # its number for the scheduler; studies have 0, runs are numbered from 1
PIECE_SECONDS = 0.008  # of work until windows are served: half of what a preview may wait


class Reports:
    """At most one check at a time, done a piece at a time. Owned by the worker thread.

    Args:
        tell: takes a notice.

    Attributes:
        number: for the scheduler.
        newest: the progress of the newest check; None: there was none.
    """

    number = REPORT_RUN

    def __init__(self, tell: Callable[[Notice], None]) -> None:
        self.newest: ReportState | None = None
        self._tell = tell
        self._work: Generator[tuple[int, int], None, CaptureReport] | None = None
        self._command = 0  # the number of the command that began it

    @property
    def training(self) -> bool:
        """Whether a check runs: the scheduler then gives it its share of the training time."""
        return self._work is not None

    def obey(self, command: StartReport | CancelReport | WriteReport, run: Run, number: int) -> None:
        """Do what a command asks for. Raises UserError if that is impossible.

        run: whose scene is checked. number: of the command, for answers that come later.
        """
        match command:
            case StartReport():
                self._work, self._command = checking(run.need_scene()), number
                self.newest = ReportState("running", text=marked("measuring photos"), loaded=run.loaded)
            case CancelReport():
                if self._work is not None and self.newest is not None:
                    self._work, self.newest = None, replace(self.newest, state="cancelled")
            case WriteReport(file):
                self._write(file)

    def advance(self) -> None:
        """Work for PIECE_SECONDS. What goes wrong is told, and the check has then failed."""
        work, state, begin = self._work, self.newest, time.perf_counter()
        if work is None or state is None:
            return
        try:
            while time.perf_counter() - begin < PIECE_SECONDS:
                done, total = next(work)
                text = phrase("photo {done:,} of {total:,}", done=done, total=total)
                self.newest = replace(state, fraction=done / total, text=text)
        except StopIteration as end:
            self._work, self.newest = None, replace(state, state="done", fraction=1.0, text="", report=end.value)
        except Exception as error:  # a fault of the check is none of the open models
            self._work, self.newest = None, replace(state, state="failed")
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            text = phrase("the photos cannot be checked: {error}", error=reason)
            detail = traceback.format_exc()
            self._tell(Notice("error", text, detail=detail, kind="failed", command=self._command))

    def _write(self, file: Path) -> None:
        if self.newest is None or self.newest.report is None:
            raise UserError("there is no capture report yet: check the photos first")
        page, _ = write_report(self.newest.report, absolute(file))
        text = phrase("wrote the capture report to {file}", file=str(page))
        self._tell(Notice("info", text, page, kind="wrote"))
