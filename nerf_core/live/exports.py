"""The export of a run that is under way: a film, a picture, or the model itself."""

from __future__ import annotations

from collections.abc import Callable

from nerf_core.common.device import enough_memory
from nerf_core.common.errors import UserError
from nerf_core.common.language import phrase
from nerf_core.rendering.export.jobs import Job
from nerf_core.rendering.export.requests import Export, ExportRequest
from nerf_core.rendering.export.start import export_job
from nerf_core.training.trainer import Trainer


class Exports:
    """At most one at a time, done a tile at a time. Owned by the worker thread.

    Args:
        tell: takes the arguments of `Run._tell`.

    Attributes:
        newest: the progress of the newest export; None: there was none.
    """

    def __init__(self, tell: Callable[..., None]) -> None:
        self.newest: Export | None = None
        self._tell = tell
        self._job: Job | None = None
        self._command = 0  # the number of the command that began it

    @property
    def running(self) -> bool:
        return self._job is not None

    def start(self, request: ExportRequest, trainer: Trainer, command: int) -> None:
        """Begin to export the model as it is now. Raises UserError if another export is running."""
        if self._job is not None:
            raise UserError(f"an export to {self._job.progress.file} is running: cancel it or wait for it")
        self._job, self._command = export_job(request, trainer.frozen_method(), trainer.scene), command
        self.newest = self._job.progress

    def cancel(self) -> None:
        if self._job is not None:
            self._job.cancel()
            self._job, self.newest = None, self._job.progress

    def advance(self) -> bool:
        """Draw one tile; return whether there was one to draw."""
        job = self._job
        if job is None:
            return False
        try:
            with enough_memory():
                job.advance()
        except UserError as error:
            self._tell(
                "error", phrase("export failed: {error}", error=str(error)), kind="failed", command=self._command
            )
        self.newest = job.progress
        if job.progress.state != "running":
            self._job = None  # with its copy of the model
        if job.progress.state == "done":
            file = job.progress.file
            self._tell("info", phrase("exported {file}", file=str(file)), file, kind="exported", command=self._command)
        return True

    def abort(self) -> None:
        """Remove the half-written file."""
        if self._job is not None:
            self._job.abort()
