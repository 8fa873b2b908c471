"""Do a study piece by piece: its rows one after the other, or on workers, then its report. It can be resumed."""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nerf_core import __version__
from nerf_core.common.configs import constants
from nerf_core.common.device import describe, pick_device
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import locked_file, write_atomically
from nerf_core.common.json_files import read_json
from nerf_core.common.language import listed, marked, phrase, phrases
from nerf_core.lab.records import Advance, Look, Report, Result, Row, RowState, StudyState
from nerf_core.lab.study import STUDIES, Bench, Study, Subject, Turnable, described

STUDY_FILE, REPORT_FILE, RESULTS_FILE = "study.json", "report.md", "results.json"
WRITTEN = "the object that `nerf-core lab` wrote"

Rows = Generator[tuple[str, Advance | Result], None, None]
RunRows = Callable[["StudyJob", tuple[Row, ...]], Rows]


class StudyJob:
    """A study that is done in pieces of work.

    progress: how far the study is. Whoever reads it gets an immutable value.
    cancelled: whether `cancel` was called.
    """

    def __init__(
        self,
        study: Study,
        subject: Subject,
        folder: Path,
        run_rows: RunRows | None = None,
        watched: bool = False,
    ) -> None:
        """Prepare the study; `advance` does the work.

        Rows that the folder already has are kept, if it holds the same study.

        Args:
            study: the study with its options.
            subject: what it is about.
            folder: where its files go.
            run_rows: does the rows that are missing; None: one after the other, here.
            watched: see `Bench.watched`.

        Raises:
            UserError: the folder holds another study or cannot be written, or the options do not fit the subject.
        """
        self.study, self.subject, self.folder = study, subject, folder
        self.name = STUDIES.name_of(type(study))
        self.tick: Callable[[], None] = lambda: None
        self.turned: dict[str, float] = {}
        self._rows = study.plan(subject)
        self._watched, self._run_rows = watched, run_rows or one_by_one
        self._results: dict[str, Result] = {}
        self._kept = 0  # how many of them are an earlier try's
        self._fractions = dict.fromkeys((row.key for row in self._rows), 0.0)
        self._began = 0.0
        self._at_work = self.cancelled = False
        self._lock = self._locked()
        try:
            self._claim()
        except BaseException:
            self._lock.close()
            raise
        self.progress = StudyState(
            self.name,
            folder,
            rows=tuple(RowState(row.label, "waiting") for row in self._rows),
            knobs=study.knobs() if isinstance(study, Turnable) else (),
        )
        self._work = self._all()

    # ---- from outside -----------------------------------------------------------------------------------------------

    def advance(self, tick: Callable[[], None] = lambda: None) -> bool:
        """Do one piece of work.

        Args:
            tick: called between the pieces of a long training step. It must not raise.

        Returns:
            Whether there is more to do; False once the report is written.

        Raises:
            UserError: a file cannot be written. The study then has failed; so it has after other errors.
        """
        if self.progress.state != "running":
            return False
        self.tick, self._at_work = tick, True
        try:
            running = next(self._work, False) is not False
        except BaseException:
            self._at_work = False
            self._end("failed")
            raise
        finally:
            self.tick, self._at_work = (lambda: None), False
        if self.cancelled and running:
            self._end("cancelled")
            return False
        if not running:
            self._lock.close()
            self.progress = replace(self.progress, state="done", fraction=1.0, seconds_left=0.0, text=marked("done"))
        return running

    def cancel(self) -> None:
        """Stop, at the end of the piece under way. What is done stays in the folder: the same study goes on from it."""
        self.cancelled = True
        if self.progress.state == "running" and not self._at_work:
            self._end("cancelled")

    def turn(self, knob: str, value: float) -> None:
        """Turn a knob. Raises UserError if the study has none of this name."""
        known = {one.name: one for one in self.progress.knobs}
        if knob not in known:
            raise UserError(f"the study {self.name} has nothing called {shorten(knob)} to turn")
        one = known[knob]
        self.turned[knob] = min(max(value, one.least), one.most)
        knobs = tuple(k._replace(value=self.turned.get(k.name, k.value)) for k in self.progress.knobs)
        self.progress = replace(self.progress, knobs=knobs)

    def _end(self, state: Any) -> None:
        self.progress = replace(self.progress, state=state, seconds_left=None)
        try:
            self._work.close()  # ends a row's training, which is saved, and unlocks its folder
        finally:
            self._lock.close()

    # ---- files ------------------------------------------------------------------------------------------------------

    def bench(self, row: Row) -> Bench:
        """Return where a row is worked on."""
        return Bench(
            self.folder / "pictures" / row.key,
            self.folder / "runs" / row.key,
            lambda: self.tick(),  # noqa: PLW0108  the newest one
            self.turned,
            self._watched,
        )

    def _locked(self) -> BinaryIO:
        """Make the folder if necessary and lock it. Raises UserError."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = locked_file(self.folder / ".lock")
        except OSError as error:
            raise UserError(f"{self.folder}: cannot be written ({error.strerror}): take another --out") from None
        if lock is None:
            raise UserError(f"{self.folder}: another study works in this folder: wait for it or take another --out")
        return lock

    def _claim(self) -> None:
        """Write what the study is into its folder, or check that the folder holds the same."""
        scene = self.subject.scene
        own = {
            "study": self.name,
            "options": described(self.study),
            "data": None if self.subject.data is None else str(self.subject.data.resolve()),
            "scene": None if scene is None else scene.identity(),
            "photo": _digest(self.subject.data) if scene is None else None,
            "kind of device": pick_device(self.subject.device).type,  # presets follow it
        }
        file = self.folder / STUDY_FILE
        if not file.exists():
            where = {"device": describe(pick_device(self.subject.device)), "version": __version__}
            write_atomically(file, json.dumps(own | where, indent=2) + "\n")
            return
        held = read_json(file, WRITTEN).values
        for name, value in own.items():
            if name in ("data", "scene") and own["scene"] is not None and held.get("scene") == own["scene"]:
                continue  # the same capture may have moved
            if held.get(name) != value:
                raise UserError(f"{self.folder}: {_difference(name, held.get(name), value)}: take another --out")
        for row in self._rows:
            result = self._stored(row)
            if result is not None:
                self._results[row.key] = result
        self._kept = len(self._results)

    def _file(self, row: Row) -> Path:
        return self.folder / "rows" / f"{row.key}.json"

    def _stored(self, row: Row) -> Result | None:
        """Return what an earlier try measured; None if there is nothing, or something else."""
        file = self._file(row)
        if not file.exists():
            return None
        held = read_json(file, WRITTEN).values
        same = held.get("row") == json.loads(json.dumps(row.values)) and isinstance(held.get("result"), dict)
        return held["result"] if same else None

    def _store(self, row: Row, result: Result) -> None:
        self._results[row.key] = result
        # what failed is tried again next time, and what somebody turned is not what the options say
        turned = any(knob.name in self.turned for knob in self.progress.knobs if not knob.of_view)
        if "failed" not in result and not turned:
            data = json.dumps({"row": row.values, "result": result}, indent=2, allow_nan=False)
            write_atomically(self._file(row), data + "\n")

    # ---- the work ---------------------------------------------------------------------------------------------------

    def _all(self) -> Generator[None, None, None]:
        self._began = time.perf_counter()
        for row in self._rows:
            if row.key in self._results:
                self._show(row, "done", marked("kept from before"))
        self._tabulate()
        left = tuple(row for row in self._rows if row.key not in self._results)
        known = {row.key: row for row in left}
        for key, piece in self._run_rows(self, left):
            row = known[key]
            if isinstance(piece, Advance):
                self._advanced(row, piece)
            else:
                self._store(row, piece)
                self._show(row, "failed" if "failed" in piece else "done", str(piece.get("failed", "")))
                self._tabulate()
            yield
        self.progress = replace(self.progress, text=marked("writing the report"))
        yield
        report = self._concluded(figures=True)
        files = self._write(report)
        drawn = tuple(Look(name, _decoded(data)) for name, data in report.figures.items()) if self._watched else ()
        self.progress = replace(self.progress, files=files, figures=drawn)

    def _advanced(self, row: Row, piece: Advance) -> None:
        self._show(row, "running", piece.text)
        self._fractions[row.key] = piece.fraction
        fraction = sum(self._fractions.values()) / len(self._rows)
        spent, done = time.perf_counter() - self._began, fraction - self._kept / len(self._rows)
        self.progress = replace(
            self.progress,
            fraction=fraction,
            text=listed((row.label, piece.text), ": ") if piece.text else row.label,
            seconds_left=spent / done * (1 - fraction) if done > 0.02 else None,
            looks=self._looks(piece),
            curves=piece.curves or self.progress.curves,
            knobs=tuple(k._replace(value=piece.knobs.get(k.name, k.value)) for k in self.progress.knobs),
            flat=piece.flat or self.progress.flat,
        )

    def _looks(self, piece: Advance) -> tuple[Any, ...]:
        """Return the newest look of every name, in the order in which they came."""
        return tuple(({look.name: look for look in self.progress.looks} | {k.name: k for k in piece.looks}).values())

    def _show(self, row: Row, state: Any, text: str) -> None:
        rows = tuple(
            RowState(one.label, state, text) if one.key == row.key else shown
            for one, shown in zip(self._rows, self.progress.rows, strict=True)
        )
        if state in ("done", "failed"):
            self._fractions[row.key] = 1.0
        self.progress = replace(self.progress, rows=rows)

    def _tabulate(self) -> None:
        if self._results:
            self.progress = replace(self.progress, tables=self._concluded(figures=False).tables)

    def _concluded(self, figures: bool) -> Report:
        """Return the report of the rows so far. Raises UserError if what an earlier try left is damaged."""
        try:
            return self.study.report(self.subject, self._results, self.folder / "pictures", figures)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OSError, OverflowError) as error:
            if not self._kept:
                raise
            reason = shorten(f"{type(error).__name__} {error}", 80)
            raise UserError(
                f"{self.folder / 'rows'}: not as this version writes it ({reason}): delete it, or take another --out"
            ) from None

    def _write(self, report: Report) -> tuple[Path, ...]:
        """Write report.md, results.json and the figures. Returns the report, then the figures."""
        figures = {f"{name}.png": data for name, data in report.figures.items()}
        for name, data in figures.items():
            write_atomically(self.folder / name, data)
        device = describe(pick_device(self.subject.device))
        about = self.subject.scene
        text = [f"# {self.study.title}", "", f"{self.study.summary}", ""]
        usual = {name: default for name, (default, _) in constants(type(self.study)).items()}
        given = {name: value for name, value in described(self.study).items() if value != usual[name]}
        options = ", ".join(f"{name.replace('_', '-')} {value}" for name, value in given.items())
        scene = f"{about.name}: {about.summary()}. " if about is not None else ""
        text += [f"{scene}Options: {options or 'the defaults'}. On {device}, nerf-viewer {__version__}.", ""]
        text += [line for table in report.tables for line in (table.markdown(), "")]
        text += [f"![{name}]({name})\n" for name in figures]
        write_atomically(self.folder / REPORT_FILE, "\n".join(text).rstrip() + "\n")
        results = {row.key: {"label": row.label, "row": row.values, "result": self._results[row.key]}
                   for row in self._rows if row.key in self._results}  # fmt: skip
        write_atomically(self.folder / RESULTS_FILE, json.dumps(results, indent=2, allow_nan=False) + "\n")
        return (self.folder / REPORT_FILE, *(self.folder / name for name in figures))


def one_by_one(job: StudyJob, rows: tuple[Row, ...]) -> Rows:
    """Do rows one after the other in this process. Yields (key, piece), and (key, result) after the last piece."""
    for row in rows:
        yield row.key, Advance(0.0, marked("begins"))
        yield from row_pieces(job.study, job.subject, row, job.bench(row))


def row_pieces(study: Study, subject: Subject, row: Row, bench: Bench) -> Rows:
    """Do one row. What the user can mend makes this row fail, and the others go on."""
    work = study.work(subject, row, bench)
    try:
        while True:
            try:
                piece = next(work)
            except StopIteration as end:
                yield row.key, end.value
                return
            yield row.key, piece
    except UserError as error:
        yield row.key, {"failed": str(error)}
    finally:
        work.close()


def _decoded(png: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def failure(job: StudyJob) -> str:
    """Return why a study has no result: the reason of its first row if all rows failed; empty if one did not."""
    rows = job.progress.rows
    return rows[0].text if rows and all(row.state == "failed" for row in rows) else ""


def summary(job: StudyJob) -> str:
    """Return one line about a study that has ended."""
    failed = sum(row.state == "failed" for row in job.progress.rows)
    rows = phrases("{n:,} row", "{n:,} rows", len(job.progress.rows))
    if failed:
        rows = phrase("{rows}, {failed} of them failed", rows=rows, failed=failed)
    return phrase("{rows}; wrote {file}", rows=rows, file=str(job.folder / REPORT_FILE))


def _digest(photo: Path | None) -> str | None:
    """Return a digest of a photo's file; None for the one that the program draws."""
    return None if photo is None else hashlib.sha256(photo.read_bytes()).hexdigest()


def _difference(name: str, held: Any, value: Any) -> str:
    if name == "options" and isinstance(held, Mapping):
        for key, new in value.items():
            if held.get(key) != new:
                option = key.replace("_", "-")
                return f"holds rows with --{option} {shorten(held.get(key))}, and not with {shorten(new)}"
    if name == "scene":
        return "holds rows of another capture"
    return f"holds rows of {name} {shorten(held)}, and not of {shorten(value)}"
