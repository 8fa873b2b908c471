"""The worker thread: alone owns the model and the device; trains, and draws what the window asks for between chunks."""

from __future__ import annotations

import math
import os
import queue
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from nerf_core.common.device import describe, memory_held
from nerf_core.common.errors import UserError
from nerf_core.datasets import load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.kernels import choice as kernels
from nerf_core.live import messages
from nerf_core.live import pin_files as watched
from nerf_core.live.artist import Artist
from nerf_core.live.budget import Budget
from nerf_core.live.messages import Command, Notice, Snapshot, ViewRequest
from nerf_core.probe import check_format, write_inspection
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.jobs import Job
from nerf_core.rendering.export.still import StillJob
from nerf_core.training import checkpoint
from nerf_core.training.last_good import LastGood
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Diverged, Trainer

PUBLISH_SECONDS = 1 / 10  # between snapshots nobody waits for: a full picture takes some 5 ms to hand over
IDLE_SECONDS = 0.25  # how long an idle worker sleeps before it looks again
NICENESS = 10  # the window's thread goes first when both want a core


# What can be obeyed in the middle of a training step: it touches neither the weights nor whose they are.
QUICK = (
    messages.SetShare, messages.Inspect, messages.StopInspecting, messages.Pin, messages.Unpin,
    messages.ExportPath, messages.ExportStill,
    messages.CancelExport,
)  # fmt: skip


class _Abandoned(Exception):
    """A step, or the loading of a scene, was given up for a command that cannot wait for its end."""


class Worker:
    """One thread behind two mailboxes.

    Commands are done in order; of `request_view` only the newest counts. `snapshot()` gives the newest state and
    `notices()` what happened since it was last called; neither ever waits. `wake` is called (from the worker's
    thread) whenever there is something new to show.
    """

    def __init__(self, settings: RunSettings, wake: Callable[[], None] = lambda: None, share: float = 0.6) -> None:
        self.settings = settings
        self.wake = wake
        self._commands: deque[Command] = deque()
        self._notices: queue.SimpleQueue[Notice] = queue.SimpleQueue()
        self._untold: list[Notice] = []  # until the state that they tell of is published
        self._view: ViewRequest | None = None
        self._skipped: ViewRequest | None = None  # a view that could not be drawn: tried again only when asked anew
        self._snapshot = Snapshot(wanted_share=share)
        self._published = 0.0
        self._thread = threading.Thread(target=self._run, name="nerf-worker", daemon=True)
        self._quit = threading.Event()  # Quit was sent; what was sent before it is still done
        self._ended = False  # and now it was its turn
        self._painted: deque[float] = deque(maxlen=1000)  # the window's frames that are not yet in the budget
        self._arrived = threading.Event()
        self._scene: Scene | None = None
        self._trainer: Trainer | None = None
        self._loaded = 0
        self._training_until: int | None = None  # step at which to pause; None: not training
        self._training_seconds = math.inf
        self._failed = False
        self._loading = ""
        self._saved_step = 0
        self._session: Mapping[str, Any] = {}
        self._rays_a_step = 0
        self._good: LastGood | None = None
        self._accounted = 0.0  # up to when the step under way is in the budget
        self._budget = Budget(share)
        self._artist = Artist()
        self._export: Job | None = None

    # ---- called from other threads --------------------------------------------------------------------------------

    def start(self) -> None:
        self._thread.start()

    def send(self, command: Command) -> None:
        self._commands.append(command)
        if isinstance(command, messages.Quit):
            self._quit.set()
        self._arrived.set()

    def request_view(self, request: ViewRequest | None) -> None:
        """What to draw from now on; None: nothing."""
        self._view = request
        self._arrived.set()

    def snapshot(self) -> Snapshot:
        return self._snapshot

    def notices(self) -> list[Notice]:
        found = []
        while True:
            try:
                found.append(self._notices.get_nowait())
            except queue.Empty:
                return found

    def painted(self, seconds: float) -> None:
        """The window drew a frame, in so many seconds: they are part of what pictures take."""
        self._painted.append(seconds)

    def stop(self, timeout: float = 5.0) -> bool:
        """Ask the thread to end; whether it did within `timeout` seconds."""
        if not self._quit.is_set():
            self.send(messages.Quit())
        self._thread.join(timeout)
        return not self._thread.is_alive()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    # ---- the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        if sys.platform == "linux":
            thread = threading.get_native_id()
            # only root may lower a niceness that the user has set higher
            os.setpriority(os.PRIO_PROCESS, thread, max(NICENESS, os.getpriority(os.PRIO_PROCESS, thread)))
        while not self._ended:
            try:
                self._turn()
            except _Abandoned:
                pass  # the command is taken next
            except Exception as error:
                self._fail(error)
        if self._export is not None:
            self._export.abort()
        self._publish(force=True)

    def _turn(self) -> None:
        """Commands first; then one training step, or one tile of a picture, or sleep."""
        self._arrived.clear()
        while self._commands and not self._ended:
            self._obey(self._commands.popleft())
            self._publish(force=True)
        trainer = self._trainer
        if self._ended:
            return
        if trainer is not None and self._training_until is not None:
            if trainer.step_count >= self._training_until or trainer.seconds >= self._training_seconds:
                self._training_until = None
            else:
                self._train_step(trainer)
        else:
            awaited = self._artist.rays.urgent
            if not self._draw(self._wanted_view()):
                self._publish(force=self._artist.fresh)
                self._arrived.wait(IDLE_SECONDS)
            elif awaited and not self._artist.rays.urgent:
                self._publish(force=True)
        self._publish()

    def _obey(self, command: Command) -> None:  # noqa: PLR0912  one branch a message
        match command:
            case messages.OpenScene(path, options, train):
                self._open(path, options if isinstance(options, RunSettings) else self.settings)
                if train:
                    self._start_training(None, None)
            case messages.Train(steps, seconds):
                self._start_training(steps, seconds)
            case messages.Pause():
                self._training_until = None
            case messages.Reset():
                self._adopt(self._need_trainer().restarted())
            case messages.UseMethod(name, train):
                self._use_method(name)
                if train:
                    self._start_training(None, None)
            case messages.SetShare(train):
                self._budget.share = min(max(train, 0.05), 0.95)
            case messages.SaveCheckpoint(path, session):
                self._save(path, session)
            case messages.LoadCheckpoint(path):
                self._load(path)
            case messages.Inspect():
                self._artist.rays.inspect(command)
            case messages.StopInspecting():
                self._artist.rays.inspect(None)
            case messages.Pin():
                self._artist.rays.pin(command, self._need_trainer())
                self._artist.rays.record(self._need_trainer())
            case messages.Unpin(number):
                self._artist.rays.unpin(number)
            case messages.ExportRays(path, names):
                self._export_rays(path, names)
            case messages.ExportPath() | messages.ExportStill():
                self._start_export(command)
            case messages.CancelExport():
                if self._export is not None:
                    self._export.cancel()
            case messages.Quit():
                self._ended = True

    # ---- scenes and checkpoints -------------------------------------------------------------------------------------

    def _open(self, path: Path | None, settings: RunSettings) -> None:
        self._loading = f"opening {path or 'the demo scene'}"
        self._publish(force=True)

        def progress(done: int, total: int) -> None:
            if self._quit.is_set():
                raise _Abandoned
            self._loading = f"loading photos: {done} of {total}"
            self._publish()

        try:
            scene = load_scene(path, settings.load, progress)
            trainer = self._made(scene, settings)
        finally:
            self._loading = ""
        self._scene, self.settings = scene, settings
        self._loaded += 1
        self._artist = Artist()
        self._adopt(trainer)
        for note in (*scene.notes, *filter(None, [kernels.note(trainer.device)])):
            self._tell(Notice("warning", note))

    def _adopt(self, trainer: Trainer) -> None:
        """Make this the model; a paused one, whose history begins now."""
        self._good = LastGood(trainer)  # raises where the weights are broken: what is open then stays
        self._trainer, self._training_until, self._failed, self._skipped = trainer, None, False, None
        self._saved_step = 0
        self._artist.forget_pictures()
        self._artist.rays.restart(trainer)
        self._artist.rays.record(trainer)

    def _use_method(self, name: str) -> None:
        settings = replace(self.settings, method=name, preset="auto", changes={})
        trainer = self._made(self._need_scene(), settings)
        self.settings = settings
        self._adopt(trainer)

    def _made(self, scene: Scene, settings: RunSettings) -> Trainer:
        """A new trainer; what makes its step fast may have to be compiled first."""
        self._loading = "preparing the method (the first time its loops are compiled)"
        self._publish(force=True)
        try:
            return Trainer(scene, settings)
        finally:
            self._loading = ""

    def _load(self, path: Path) -> None:
        description, state = checkpoint.load(path)
        scene = self._need_scene()
        if description["scene"] != scene.identity():
            raise UserError(f"{path}: {scene.difference(description)}")
        trainer = Trainer.resume(scene, description, state, self.settings.device)
        self._adopt(trainer)
        try:
            self._artist.rays.know(watched.restored(description, state))
        except UserError as error:
            self._tell(Notice("warning", str(error)))
        for note in trainer.notes(description):
            self._tell(Notice("warning", note))
        self._saved_step = description["step"]
        self._session = description.get("session", {})  # older ones have none
        if self.settings.method not in ("auto", trainer.method_name):
            asked = self.settings.method
            text = f"{path.name} holds a model of method {trainer.method_name}: --method {asked} is not used"
            self._tell(Notice("warning", text))
        self._tell(Notice("info", f"loaded {path.name}: step {description['step']:,}", path))

    def _save(self, path: Path, session: Mapping[str, Any]) -> None:
        trainer = self._need_trainer()
        seen = self._artist.rays.histories()
        description = trainer.describe() | {"session": dict(session)} | watched.described(seen)
        checkpoint.save(path, description, trainer.state() | watched.state(seen))
        self._saved_step = trainer.step_count
        self._tell(Notice("info", f"saved step {trainer.step_count:,} to {path}", path))

    def _export_rays(self, path: Path, names: Mapping[int, str]) -> None:
        check_format(path)
        write_inspection(self._artist.rays.whole(self._need_trainer(), names), path)
        self._tell(Notice("info", f"wrote {path}", path))

    def _need_scene(self) -> Scene:
        if self._scene is None:
            raise UserError("no scene is open: open one first")
        return self._scene

    def _need_trainer(self) -> Trainer:
        if self._trainer is None:
            raise UserError("no scene is open: open one first")
        return self._trainer

    # ---- training ---------------------------------------------------------------------------------------------------

    def _start_training(self, steps: int | None, seconds: float | None) -> None:
        trainer = self._need_trainer()
        self._failed, self._skipped = False, None
        self._training_seconds = math.inf if seconds is None else trainer.seconds + seconds
        end = trainer.total_steps if steps is None else trainer.step_count + steps
        if trainer.step_count >= end:
            self._tell(Notice("info", f"all {trainer.total_steps:,} steps of the schedule are done"))
        else:
            self._training_until = end

    def _train_step(self, trainer: Trainer) -> None:
        try:
            self._accounted = time.perf_counter()
            self._painted.clear()  # before this step they took nothing from training
            report = trainer.step(self._pump)
            if self._good is not None and self._good.due():
                self._good.remember(trainer)
        except Diverged as error:
            self._recover(trainer, error)
            return
        except torch.OutOfMemoryError as error:
            self._training_until = None
            raise UserError(
                f"out of device memory: {error}; use a smaller step: --set rays, samples or chunk_rays"
            ) from None
        self._account_for_training(report.rays)
        self._rays_a_step = report.rays
        begin = time.perf_counter()
        if self._artist.rays.record(trainer):
            self._budget.drew(time.perf_counter() - begin)
        if report.note:
            self._tell(Notice("warning", report.note))

    def _account_for_training(self, rays: int) -> None:
        """Since `_accounted`, less the window's frames: without a graphics card they take the cores away meanwhile."""
        seconds, painted = time.perf_counter() - self._accounted, 0.0
        while self._painted:
            painted += self._painted.popleft()
        self._budget.trained(max(0.0, seconds - painted), rays)
        self._budget.showed(painted)

    def _recover(self, trainer: Trainer, error: Diverged) -> None:
        """Back to the last weights that were known to be good, paused."""
        self._training_until, self._failed = None, True
        if self._good is not None:
            self._good.restore(trainer)
            self._artist.rays.rewind(trainer.step_count)
            self._saved_step = min(self._saved_step, trainer.step_count)
        self._artist.forget_pictures()
        self._tell(Notice("error", f"{error}; back at step {trainer.step_count:,}, paused"))

    def _pump(self) -> None:
        """Between two gradient chunks: obey, and serve the window for as long as the budget allows.

        A step can take long. Commands that need it to end, to close the window or to pause, say, abandon it: it has
        then not happened.
        A ray that was asked for is opened at once, and a new view gets its first pixels, but only one of each a time,
        and a hand that keeps moving only as many as the budget allows: it must not stop the training.
        """
        while self._commands and isinstance(self._commands[0], QUICK):
            self._obey(self._commands.popleft())
            self._publish(force=True)
        if self._commands:
            raise _Abandoned
        self._account_for_training(0)
        view = self._wanted_view()
        if self._artist.rays.urgent and self._budget.may_follow():
            self._serve(lambda: self._artist.rays.urgent and not self._commands and self._draw(view))
        if view is not None and (not view.moving or self._budget.may_follow()):
            self._serve(lambda: self._artist.urgent(view) and (view is self._view or view.moving) and self._draw(view))
        while self._budget.may_draw() and not self._artist.urgent(self._view) and self._draw(self._wanted_view()):
            self._publish()
        self._publish()
        self._accounted = time.perf_counter()

    def _serve(self, piece: Callable[[], bool]) -> None:
        """Do what somebody waits for, a piece at a time, and show it before anything else is done."""
        begin = time.perf_counter()
        if not piece():
            return
        while piece():
            self._publish()
        self._publish(force=True)
        self._budget.followed(time.perf_counter() - begin)

    # ---- pictures ---------------------------------------------------------------------------------------------------

    def _wanted_view(self) -> ViewRequest | None:
        view = self._view
        return None if view is self._skipped else view

    def _draw(self, view: ViewRequest | None) -> bool:
        """One piece of drawing of at most some 15 ms; whether there was any to do."""
        trainer = self._trainer
        if trainer is None:
            return False
        begin = time.perf_counter()
        turns = [self._draw_export, lambda: self._draw_picture(trainer, view)]
        if self._artist.urgent(view) or self._artist.rays.urgent or self._budget.artist_is_next():
            turns.reverse()
        did = any(turn() for turn in turns)
        if did:
            self._budget.drew(time.perf_counter() - begin)
        return did

    def _draw_picture(self, trainer: Trainer, view: ViewRequest | None) -> bool:
        try:
            return self._artist.draw(trainer, view, self._training_until is not None)
        except UserError:  # a mode that the method cannot draw: reported once, not at every turn
            self._skipped = view
            raise

    def _draw_export(self) -> bool:
        job = self._export
        if job is None:
            return False
        try:
            running = job.advance()
        except UserError as error:
            running = False
            self._tell(Notice("error", f"export failed: {error}"))
        if not running:
            self._export = None
            if job.progress.state == "done":
                self._tell(Notice("info", f"exported {job.progress.file}", job.progress.file))
        self._snapshot = replace(self._snapshot, export=job.progress)
        return True

    def _start_export(self, command: messages.ExportPath | messages.ExportStill) -> None:
        trainer = self._need_trainer()
        if self._export is not None:
            raise UserError(f"an export to {self._export.progress.file} is running: cancel it or wait for it")
        method = trainer.frozen_method()
        if isinstance(command, messages.ExportPath):
            self._export = FilmJob(method, trainer.scene, command)
        else:
            self._export = StillJob(method, trainer.scene, command)

    # ---- messages ---------------------------------------------------------------------------------------------------

    def _fail(self, error: Exception) -> None:
        """An error is a message: the thread lives on and so does what was open."""
        if isinstance(error, UserError):
            self._tell(Notice("error", str(error)))
        else:
            self._training_until, self._failed = None, True
            self._skipped = self._view  # what cannot be drawn is reported once, not at every turn
            text = f"{type(error).__name__}: {error}".splitlines()[0]
            self._tell(Notice("error", f"the worker failed: {text}", detail=traceback.format_exc()))
        self._publish(force=True)

    def _status(self) -> messages.Status:
        if self._loading:
            return "loading"
        if self._failed:
            return "failed"
        trainer = self._trainer
        if trainer is None:
            return "empty"
        if self._training_until is not None:
            return "training"
        if trainer.step_count >= trainer.total_steps:
            return "finished"
        return "paused" if trainer.step_count else "ready"

    def _tell(self, notice: Notice) -> None:
        """With the next snapshot: whoever hears of something finds it there."""
        self._untold.append(notice)

    def _publish(self, force: bool = False) -> None:
        now = time.monotonic()
        if not (force or self._untold) and now - self._published < PUBLISH_SECONDS:
            return
        self._published, begin = now, time.perf_counter()
        try:
            self._snapshot = self._shown()
        finally:  # what broke is told even where there is nothing more to show
            for notice in self._untold:
                self._notices.put(notice)
            self._untold.clear()
        self.wake()
        self._budget.showed(time.perf_counter() - begin)

    def _shown(self) -> Snapshot:
        status, trainer = self._status(), self._trainer
        common = replace(
            self._snapshot, status=status, loading=self._loading, loaded=self._loaded, scene=self._scene,
            wanted_share=self._budget.share,
        )  # fmt: skip
        if trainer is not None:
            rays = self._artist.rays
            rate = self._budget.rays_per_second() if status == "training" else 0.0
            left = None
            if rate and self._training_until is not None:
                left = (self._training_until - trainer.step_count) * self._rays_a_step / rate
            common = replace(
                common,
                method=trainer.method_name,
                coarse=trainer.method.coarse,
                stage=trainer.method.stage,
                method_reason=trainer.reason,
                device=describe(trainer.device),
                step=trainer.step_count,
                saved_step=self._saved_step,
                total_steps=trainer.total_steps,
                seconds=trainer.seconds,
                rays_per_second=rate,
                seconds_left=left,
                train_share=self._budget.train_share(),
                memory_bytes=memory_held(trainer.device),
                history=trainer.history.view(),
                preview=self._artist.preview(common.preview),
                opened=rays.opened,
                opened_step=rays.opened_step,
                pinned=rays.pinned(),
                session=self._session,
                preview_rays_per_second=self._artist.rays_per_second("fine"),
            )
        return common
