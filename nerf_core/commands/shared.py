"""What several subcommands do alike: load a run, show progress, say notes and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nerf_core.common.console import Display
from nerf_core.common.output import complain, say
from nerf_core.common.signals import Signals
from nerf_core.methods.group import ALONE, Group
from nerf_core.rendering.export.jobs import Job
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Trainer

MOVED_HELP = "Where the capture is now, if it moved."


@contextmanager
def loading() -> Iterator[Callable[[str, int, int], None]]:
    """A progress display for photos; yields what to call as (what is done, photos done, photos in all)."""
    with Display("loading") as display:
        yield lambda words, done, total: display.show(done / total, f"{words}: {done:,} of {total:,}")


def restored(run: RunFolder, data: Path | None, device: str, group: Group = ALONE) -> Trainer:
    """The newest checkpoint of a run with its scene; notes about both are printed. Raises UserError.

    group: the processes that will train it together.
    """
    with loading() as progress:
        trainer, notes = run.restore(data, device, progress, group)
    tell(notes)
    return trainer


def finished(job: Job, signals: Signals, label: str, text: str) -> None:
    """Do all of a job's work and show how far it is. A signal cancels it and leaves no half-written file.

    Call `signals.be_polite()` before the job is made: it opens its file at once.
    """
    try:
        with Display(label) as display:
            while job.advance():
                signals.check()
                display.show(job.progress.done / max(job.progress.total, 1), text, job.progress.seconds_left)
    finally:
        job.abort()  # of a finished file: does nothing


def tell(notes: Sequence[str]) -> None:
    """Print each note on a line."""
    for note in notes:
        say(f"note: {note}")


def warn(text: str) -> None:
    """Print a warning on standard error."""
    complain(f"warning: {text}")
