"""The worker thread: alone owns models and devices; trains runs, and draws what windows ask for between chunks."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_core.common import collector
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase
from nerf_core.datasets.capture import DATASETS, LoadOptions
from nerf_core.lab.study import STUDIES
from nerf_core.live import messages
from nerf_core.live.drawing import Drawing
from nerf_core.live.mailbox import Mailbox
from nerf_core.live.messages import FIRST_RUN, Command, Notice, Snapshot, ViewRequest
from nerf_core.live.reports import Reports
from nerf_core.live.scheduler import Scheduler
from nerf_core.live.shares import Situation
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings

if TYPE_CHECKING:
    from nerf_core.live.run import Run
    from nerf_core.live.studies import Studies

PUBLISH_SECONDS = 1 / 10  # between snapshots nobody waits for: a full picture takes some 5 ms to hand over
IDLE_SECONDS = 0.25  # how long an idle worker sleeps before it looks again
NICENESS = 10  # the window's thread goes first when both want a core


class _Abandoned(Exception):
    """A training step, or the loading of a scene, was abandoned for a command that cannot wait for its end."""


class Worker:
    """One thread behind a mailbox. It owns the runs; run FIRST_RUN exists from the beginning.

    Commands are obeyed in order. Of the views that are requested of a run, only the newest counts. No method waits for
    the thread but `stop`.

    Args:
        settings: for runs in which no scene has been opened yet.
        wake: called from the worker's thread whenever there is something new to show.
        share: the part of the worker's time that training keeps while pictures are drawn, 0.05 … 0.95.
    """

    def __init__(self, settings: RunSettings, wake: Callable[[], None] = lambda: None, share: float = 0.6) -> None:
        self._mailbox = Mailbox(wake, share)
        self._scheduler = Scheduler(share)
        self._settings = settings
        self._runs: dict[int, Run] = {}
        self._thread = threading.Thread(target=self._live, name="nerf-worker", daemon=True)
        self._ended = False  # Quit was obeyed
        self._done = threading.Event()  # the thread has nothing more to do
        self._untold: list[Notice] = []  # until the state that they tell of is published
        self._published = 0.0
        self._command = 0  # the number of the command that is being obeyed
        self._drawing = Drawing(self._runs, self._mailbox, self._scheduler.budget)
        self._studies: Studies | None = None  # from when torch is loaded
        self._report = Reports(self._tell)
        self._trained: Run | None = None  # the run whose step is under way
        self._accounted = 0.0  # up to when the step under way is in the budget

    # ---- called from other threads --------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread. The first run is "loading" until torch is loaded, which takes a second."""
        if "torch" not in sys.modules:
            first = self._mailbox.snapshot(FIRST_RUN)
            self._mailbox.deliver({FIRST_RUN: replace(first, status="loading", loading=marked("PyTorch is loading"))})
        self._thread.start()

    def send(self, command: Command) -> int:
        """Queue a command; see `Mailbox.send`."""
        return self._mailbox.send(command)

    def request_view(self, request: ViewRequest | None, run: int = FIRST_RUN) -> None:
        """Draw this view of a run from now on; None: draw nothing."""
        self._mailbox.request_view(request, run)

    def snapshot(self, run: int = FIRST_RUN) -> Snapshot:
        """Return the newest state of a run. Raises KeyError if there is no such run."""
        return self._mailbox.snapshot(run)

    def snapshots(self) -> Mapping[int, Snapshot]:
        """Return the newest state of every run, by its number."""
        return self._mailbox.snapshots()

    def notices(self) -> list[Notice]:
        """Return what happened since the last call, in order."""
        return self._mailbox.notices()

    def paints(self) -> None:
        """Let the window draw a frame: until `painted`, training waits, because both want all cores."""
        self._mailbox.paints()

    def painted(self, seconds: float) -> None:
        """Count the seconds that the window took for a frame as part of the time for pictures."""
        self._mailbox.painted(seconds)

    def stop(self, timeout: float = 5.0) -> bool:
        """Ask the thread to end, wait `timeout` seconds at most, and return whether it ended."""
        if not self._mailbox.quitting:
            self.send(messages.Quit())
        # not join(): where a signal's exception interrupts it, Python up to 3.12 takes the thread for ended
        if not self._done.wait(timeout):
            return False
        self._thread.join()
        return True

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def opened(self, run: int = FIRST_RUN) -> tuple[Path | None, LoadOptions]:
        """Return what opens a run's scene again: its capture (None: the demo scene), and the options of loading.

        Call it after the thread has ended.
        """
        return self._runs[run].capture, self._runs[run].settings.load

    # ---- the thread -------------------------------------------------------------------------------------------------

    def _live(self) -> None:
        try:
            if self._prepare():
                self._work()
        finally:
            self._done.set()

    def _prepare(self) -> bool:
        """Load what trains and draws, make the first run, and return whether that went well.

        torch takes a second to load, and the methods need it. A window opens meanwhile: it asks for them only when the
        first run is no longer "loading".
        """
        try:
            loaded = "torch" in sys.modules
            with collector.paused():
                METHODS.names()  # loads them
                DATASETS.names()
                STUDIES.names()
                from nerf_core.live.studies import Studies
            if not loaded:
                # What was imported lives as long as the process. If the collector looked at it whenever it looks at
                # everything, the window would have to wait.
                gc.freeze()

            self._studies = Studies(self._tell)
            self._runs[FIRST_RUN] = self._new_run(FIRST_RUN)
        except Exception as error:  # an installation that is not complete, say
            text = phrase("the worker failed: {error}", error=f"{type(error).__name__}: {error}")
            first = replace(self._mailbox.snapshot(FIRST_RUN), status="failed", loading="")
            self._mailbox.deliver({FIRST_RUN: first})
            self._mailbox.tell(Notice("error", text, detail=traceback.format_exc(), kind="failed", run=FIRST_RUN))
            self._mailbox.wake()
            return False
        for problem in (*METHODS.problems, *DATASETS.problems):
            self._mailbox.tell(Notice("warning", problem))
        return True

    def _work(self) -> None:
        if sys.platform == "linux":
            thread = threading.get_native_id()
            # only root may lower a niceness that the user has set higher
            os.setpriority(os.PRIO_PROCESS, thread, max(NICENESS, os.getpriority(os.PRIO_PROCESS, thread)))
        try:
            while not self._ended:
                try:
                    self._turn()
                except _Abandoned:
                    pass  # the command is taken next
                except Exception as error:
                    at_work = self._drawing.at_work or self._trained
                    self._fail(error, at_work.number if at_work else FIRST_RUN)
                self._drawing.at_work = self._trained = None
        finally:
            for run in self._runs.values():
                run.close()
            self._study.cancel()
        self._publish(force=True)

    def _turn(self) -> None:
        """Obey all commands; then do one training step, or draw one piece, or sleep."""
        self._mailbox.begin_turn()
        while not self._ended and self._mailbox.next_command() is not None:
            self._obey_next()
        if self._ended:
            return
        for run in self._runs.values():
            run.pause_if_done()
            run.tell_of_photos()
        number = self._scheduler.next_run([*self._runs.values(), self._study, self._report])
        if number == self._study.number:
            self._study_piece()
        elif number == self._report.number:
            self._report_piece()
        elif number is not None:
            self._train_step(self._runs[number])
        else:
            self._mailbox.let_paint()
            awaited = self._drawing.ray_awaited()
            if not self._drawing.piece():
                self._publish(force=any(run.artist.fresh for run in self._runs.values()))
                self._mailbox.wait(IDLE_SECONDS)
            elif awaited and not self._drawing.ray_awaited():
                self._publish(force=True)
        self._publish()

    def _obey_next(self) -> None:
        self._command, command = self._mailbox.take()
        try:
            self._obey(command)
        except _Abandoned:
            if not self._mailbox.quitting:
                self._tell(Notice("info", marked("loading was cancelled: what was open stays open")))
        except Exception as error:
            self._fail(error, command.run if isinstance(command, messages.OfRun) else FIRST_RUN)
        finally:
            self._command = 0
        self._publish(force=True)

    def _obey(self, command: Command | messages.OfRun) -> None:
        match command:
            case messages.SetShare(share, rule):
                self._scheduler.set_share(share, rule)
            case messages.InOrder(commands):
                for one in commands:
                    self._obey(one)
            case messages.CancelLoading():
                pass  # what was loading has ended
            case messages.Quit():
                self._ended = True
            case messages.OpenRun(method, like, train):
                self._open_run(command.run, method, self._run(like))
                if train:
                    self._runs[command.run].train(None, None)
            case messages.CloseRun():
                self._close_run(self._run(command.run))
            case messages.StartStudy() | messages.CancelStudy() | messages.TurnKnob():
                self._study.obey(command, self._run(command.run), self._command)
            case messages.StartReport() | messages.CancelReport() | messages.WriteReport():
                self._report.obey(command, self._run(command.run), self._command)
            case _:
                run = self._run(command.run)
                before = run.trainer
                run.obey(command, self._command)
                if run.trainer is not before:
                    self._scheduler.forget(run.number)

    @property
    def _study(self) -> Studies:
        assert self._studies is not None  # `_prepare` made it
        return self._studies

    # ---- runs -------------------------------------------------------------------------------------------------------

    def _new_run(self, number: int) -> Run:
        from nerf_core.live.run import Run

        return Run(number, self._settings, self._tell, self._say_loading)

    def _run(self, number: int) -> Run:
        if number not in self._runs:
            raise UserError(f"there is no run {number}: there are {', '.join(map(str, self._runs))}")
        return self._runs[number]

    def _open_run(self, number: int, method: str, like: Run) -> None:
        if number in self._runs:
            raise UserError(f"run {number} is open already: close it first, or take another number")
        run = self._new_run(number)
        run.use_method(like.need_scene(), like.settings, method)
        run.capture = like.capture
        self._runs[number] = run

    def _close_run(self, run: Run) -> None:
        if run.number == FIRST_RUN:
            raise UserError("the first run stays open: open another scene in it")
        run.close()
        del self._runs[run.number]
        self._mailbox.request_view(None, run.number)

    def _say_loading(self, now: bool) -> None:
        """Show how far loading is. Raises _Abandoned if it is no longer wanted."""
        if self._mailbox.must_not_load(self._command):
            raise _Abandoned
        self._publish(force=now)

    # ---- training ---------------------------------------------------------------------------------------------------

    def _train_step(self, run: Run) -> None:
        self._trained, self._accounted = run, time.perf_counter()
        self._mailbox.paint_seconds()  # before this step they took nothing from training
        report = run.step(lambda: self._between_chunks(run.number))
        if report is None:
            self._trained = None
            return
        self._account_for_training(run.number, report.rays)
        from nerf_core.common.device import enough_memory

        begin = time.perf_counter()
        with enough_memory():
            recorded = run.artist.pins.record(run.need_trainer())
        if recorded:
            self._scheduler.budget.drew(time.perf_counter() - begin)
        self._trained = None

    def _study_piece(self) -> None:
        """Do a piece of the study. It counts as training, and windows are served in it as in a training step."""
        self._accounted = time.perf_counter()
        self._mailbox.paint_seconds()
        between = partial(self._between_chunks, self._study.number, may_abandon=False)
        self._study.advance(between)
        between()

    def _report_piece(self) -> None:
        """Do a piece of the check of photos, like one of a study."""
        self._accounted = time.perf_counter()
        self._mailbox.paint_seconds()
        self._report.advance()
        self._between_chunks(self._report.number, may_abandon=False)

    def _account_for_training(self, number: int, rays: int) -> None:
        """Count the time since `_accounted` as training of a run, less the window's frames.

        Without a graphics card, those take the processor's cores away from training.
        """
        seconds, painted = time.perf_counter() - self._accounted, self._mailbox.paint_seconds()
        self._scheduler.trained(number, max(0.0, seconds - painted), rays)
        self._scheduler.budget.showed(painted)

    def _between_chunks(self, trained: int, may_abandon: bool = True) -> None:
        """Between two gradient chunks: obey, and serve the windows for as long as the budget allows.

        trained: the number of the run, or of the study. may_abandon: whether the step is abandoned for a command that
        needs it to end; else that command waits.

        A step can take long. A command that needs it to end, to close the window or to pause, say, abandons it: the
        step has then not happened. At each call, one requested ray is opened and one new view gets its first pixels.
        For rays, and while the camera moves, the budget limits how often, so that training goes on.
        """
        while (waiting := self._mailbox.next_command()) is not None:
            if not waiting[1].quick:
                if may_abandon:
                    raise _Abandoned
                break
            self._obey_next()
        self._mailbox.let_paint()
        self._account_for_training(trained, 0)
        self._adapt()
        budget, served = self._scheduler.budget, False
        for run in list(self._runs.values()):
            view = self._drawing.view(run)
            if run.artist.ray.urgent and budget.may_follow():
                served |= self._serve(lambda run=run: self._ray_goes_on(run) and self._drawing.piece_of(run))
            if view is not None and (not view.moving or budget.may_follow()):
                served |= self._serve(
                    lambda r=run, v=view: self._drawing.wants_pixels(r, v) and self._drawing.piece_of(r, v)
                )
        while budget.may_draw() and not self._drawing.pixels_awaited() and self._drawing.piece():
            self._publish()
            self._mailbox.let_paint()
        self._publish()
        if served:
            self._mailbox.let_paint(soon=True)
        budget.showed(self._mailbox.paint_seconds())  # these frames took nothing from training
        self._accounted = time.perf_counter()

    def _ray_goes_on(self, run: Run) -> bool:
        return run.artist.ray.urgent and self._mailbox.next_command() is None

    def _adapt(self) -> None:
        views = [self._drawing.view(run) for run in self._runs.values()]
        self._scheduler.adapt(
            Situation(
                moving=any(view is not None and view.moving for view in views),
                exporting=any(run.exports.running for run in self._runs.values()),
            )
        )

    def _serve(self, piece: Callable[[], bool]) -> bool:
        """Do what somebody waits for, a piece at a time, and publish it before anything else is done.

        Returns whether there was any.
        """
        begin = time.perf_counter()
        if not piece():
            return False
        while piece():
            self._publish()
        self._publish(force=True)
        self._scheduler.budget.followed(time.perf_counter() - begin)
        return True

    # ---- messages ---------------------------------------------------------------------------------------------------

    def _fail(self, error: Exception, number: int) -> None:
        """Tell of an error in a run. The thread lives on, and so does what is open."""
        if isinstance(error, UserError):
            self._tell(Notice("error", str(error), kind="failed", run=number))
        else:
            if number in self._runs:  # a run that could not be opened is not
                self._runs[number].fail(self._mailbox.view(number))  # what cannot be drawn is not tried at every turn
            text = f"{type(error).__name__}: {error}".splitlines()[0]
            text = phrase("the worker failed: {error}", error=text)
            told = Notice("error", text, detail=traceback.format_exc(), kind="failed")
            self._tell(replace(told, run=number))
        self._publish(force=True)

    def _tell(self, notice: Notice) -> None:
        """Deliver a notice with the next snapshot, so that whoever reads it finds there what it tells of."""
        self._untold.append(replace(notice, command=notice.command or self._command))

    def _publish(self, force: bool = False) -> None:
        now = time.monotonic()
        if not (force or self._untold) and now - self._published < PUBLISH_SECONDS:
            return
        self._published, begin = now, time.perf_counter()
        before, empty = self._mailbox.snapshots(), Snapshot()
        self._mailbox.deliver({n: self._snapshot(run, before.get(n, empty)) for n, run in self._runs.items()})
        for notice in self._untold:
            self._mailbox.tell(notice)
        self._untold.clear()
        self._mailbox.wake()
        self._scheduler.budget.showed(time.perf_counter() - begin)

    def _snapshot(self, run: Run, before: Snapshot) -> Snapshot:
        """Return the state of a run. If the device or the method raises, the run fails and keeps its last state."""
        from nerf_core.live.snapshot import snapshot_of, status_of

        try:
            return replace(
                snapshot_of(run, before, self._scheduler), study=self._study.newest, report=self._report.newest
            )
        except Exception as error:
            if not run.failed:  # told once, not at every snapshot
                run.fail(self._mailbox.view(run.number))
                reason = f"{type(error).__name__}: {error}".splitlines()[0]
                text = phrase("the state of the run cannot be read: {error}", error=reason)
                self._tell(Notice("error", text, detail=traceback.format_exc(), kind="failed", run=run.number))
            return replace(before, run=run.number, status=status_of(run))
