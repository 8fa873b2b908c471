"""A run: one scene, one trainer, the pictures of it that a window shows, and its opened rays."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerf_core.captures.opening import open_capture
from nerf_core.captures.records import PoseProgress
from nerf_core.common.device import enough_memory
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase, phrases
from nerf_core.common.memory import give_back
from nerf_core.common.names import printable
from nerf_core.common.user_paths import absolute
from nerf_core.datasets.images import damage_notes
from nerf_core.geometry.photos import PhotosLost
from nerf_core.geometry.scene import Scene
from nerf_core.kernels import choice as kernels
from nerf_core.live import messages, pin_files
from nerf_core.live.artist import Artist
from nerf_core.live.exports import Exports
from nerf_core.live.messages import Notice, ViewRequest
from nerf_core.methods import nothing_to_train
from nerf_core.probe import check_format, write_inspection
from nerf_core.probe.axis import AxisChoice
from nerf_core.training import checkpoint
from nerf_core.training.autosaves import checkpoint_name, left_off, small_picture, spare_files
from nerf_core.training.last_good import LastGood
from nerf_core.training.last_save import save_somewhere
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Diverged, Report, Trainer


class Stored(NamedTuple):
    """A checkpoint that was read: its file, description and tensors."""

    file: Path
    description: dict[str, Any]
    state: dict[str, Tensor]


class Run:
    """Owned by the worker thread, which does one piece of one run at a time.

    Args:
        number: other runs of the worker have other numbers.
        settings: until a scene is opened with its own.
        tell: takes a notice.
        say_loading: publishes `loading`; True: at once, False: when it is time. What it raises ends the loading.
    """

    def __init__(
        self,
        number: int,
        settings: RunSettings,
        tell: Callable[[Notice], None],
        say_loading: Callable[[bool], None],
    ) -> None:
        self.number, self.settings = number, settings
        self._tell_worker, self._say_loading = tell, say_loading
        self.scene: Scene | None = None
        self.capture: Path | None = None  # where the scene was loaded from; None: the demo scene
        self.trainer: Trainer | None = None
        self.artist = Artist()
        self.skipped: ViewRequest | None = None  # a view that could not be drawn: tried again when asked anew
        self.exports = Exports(self._tell)
        self._ray_command = 0  # the number of the command that opened the ray
        self.failed = False
        self.loading = ""
        self.posing: PoseProgress | None = None
        self.loaded = 0
        self.until: int | None = None  # the step at which training pauses; None: it does not train
        self._until_seconds = math.inf
        self._limited = False  # whether the user said how long it trains
        self._saved: tuple[Path, int] | None = None  # the newest checkpoint that was written or loaded, and its step
        self.rays_per_step = 0
        self._told_of = 0  # the number of the scene, in `loaded`, of which it was told that all photos are read
        self._good: LastGood | None = None

    # ---- commands ---------------------------------------------------------------------------------------------------

    def obey(self, command: messages.OfRun, number: int) -> None:  # noqa: PLR0912  one branch per message
        """Do what a command asks for. Raises UserError if that is impossible; the run is then as it was.

        number: of the command, for answers that come after this returns.
        """
        match command:
            case messages.OpenScene(path, options, train, file):
                self.open(path, options, file)
                if train:
                    self.train(None, None)
            case messages.Train(steps, seconds):
                self.train(steps, seconds)
            case messages.Pause():
                self.pause()
            case messages.Reset():
                self._adopt(self.need_trainer().restarted())
            case messages.UseMethod(name, train, changes):
                self.use_method(self.need_scene(), self.settings, name, changes)
                if train:
                    self.train(None, None)
            case messages.SaveCheckpoint(path):
                self._save([path])
            case messages.SaveUnsaved(file, folder):
                self._save_unsaved(file, folder)
            case messages.LoadCheckpoint(path):
                self._load(path)
            case messages.Inspect():
                self.artist.ray.inspect(command)
                self._ray_command = number
            case messages.StopInspecting():
                self.artist.ray.inspect(None)
            case messages.PinRay():
                self.artist.pins.add(command, self.need_trainer())
                with enough_memory():
                    self.artist.pins.record(self.need_trainer())
            case messages.EditPin():
                self.artist.pins.edit(command)
            case messages.UnpinRay(pin):
                self.artist.pins.remove(pin)
            case messages.ExportRays(path, axis):
                self._export_rays(path, axis)
            case messages.StartExport(request):
                with enough_memory():  # for a copy of the model
                    self.exports.start(request, self.need_trainer(), number)
            case messages.CancelExport():
                self.exports.cancel()
            case _:
                raise AssertionError(f"no run obeys {command}")

    def need_scene(self) -> Scene:
        """Raises UserError if nothing is open."""
        if self.scene is None:
            raise UserError("no scene is open: open one first")
        return self.scene

    def need_trainer(self) -> Trainer:
        """Raises UserError if nothing is open."""
        if self.trainer is None:
            raise UserError("no scene is open: open one first")
        return self.trainer

    # ---- scenes and checkpoints -------------------------------------------------------------------------------------

    def open(self, path: Path | None, settings: RunSettings, file: Path | None = None) -> None:
        """Load a capture and make a model of it. If anything fails, the open scene and model stay.

        file: the checkpoint that holds the model; None: it is a fresh one.
        """

        def progress(words: str, done: int, total: int) -> None:
            self._busy_with(phrase("{words}: {done:,} of {total:,}", words=words, done=done, total=total), now=False)

        def posing(state: PoseProgress) -> None:
            self.posing = state
            progress(phrase(state.stage), state.done, state.total)

        path = None if path is None else absolute(path)  # the current folder may go while it is open
        opening = phrase("opening the demo scene") if path is None else phrase("opening {path}", path=str(path))
        with self._busy(opening):
            stored = None if file is None else Stored(file, *checkpoint.load(file))
            try:
                scene = open_capture(path, settings.load, progress, posing)
            except UserError as error:
                raise error if file is None else UserError(f"{error}; then load {file}") from None
            trainer = self._made(scene, settings) if stored is None else self._resumed(scene, settings, stored)
            good = LastGood(trainer, rounded=True)
            self._say_loading(True)  # the last moment at which it can be cancelled
        self.artist = Artist()
        self._commit(scene, settings, trainer, good)
        self.capture = path
        self.loaded += 1
        for note in (*scene.notes, *filter(None, [kernels.note(trainer.device)])):
            self._tell("warning", note)
        if stored is not None:
            self._take_over(stored, trainer)
            return
        self.artist.pins.add_landmarks(scene, trainer)
        self.artist.pins.record(trainer)

    def use_method(
        self, scene: Scene, settings: RunSettings, name: str, changes: Mapping[str, str] | None = None
    ) -> None:
        """Begin anew on `scene` with another method and its own constants; see `messages.UseMethod`."""
        settings = replace(settings, method=name, preset="auto", changes=dict(changes or {}))
        with self._busy(""):
            trainer = self._made(scene, settings)
            good = LastGood(trainer, rounded=True)
            self._say_loading(True)
        fresh = self.scene is None
        self._commit(scene, settings, trainer, good)
        self.loaded += fresh
        self._tell("info", phrase("a fresh model of method {method}", method=trainer.method_name), kind="loaded")

    def _made(self, scene: Scene, settings: RunSettings) -> Trainer:
        self._busy_with(marked("preparing the method (the first time its loops are compiled)"))
        return Trainer(scene, settings)

    def _adopt(self, trainer: Trainer) -> None:
        """Take another model of the open scene, paused. Raises Diverged for broken weights; the old one then stays."""
        self._commit(self.need_scene(), self.settings, trainer, LastGood(trainer, rounded=True))

    def _commit(self, scene: Scene, settings: RunSettings, trainer: Trainer, good: LastGood) -> None:
        """End a transaction. Only opening pinned rays can fail here; a ray that fails is told of and unpinned."""
        self.scene, self.settings, self.trainer, self._good = scene, settings, trainer, good
        self.until, self.failed, self.skipped, self._saved = None, False, None, None
        self.artist.forget_pictures()
        self.artist.pins.restart(trainer)
        self.artist.pins.record(trainer)

    def _load(self, path: Path) -> None:
        stored = Stored(path, *checkpoint.load(path))
        trainer = self._resumed(self.need_scene(), self.settings, stored)
        self._adopt(trainer)
        self._take_over(stored, trainer)

    @staticmethod
    def _resumed(scene: Scene, settings: RunSettings, stored: Stored) -> Trainer:
        if not scene.is_of(stored.description):
            raise UserError(f"{stored.file}: {scene.difference(stored.description)}")
        with checkpoint.named(stored.file):
            return Trainer.resume(scene, stored.description, stored.state, settings.device)

    def _take_over(self, stored: Stored, trainer: Trainer) -> None:
        """Take what a checkpoint has besides the model, which is adopted already, and tell of it."""
        path, description = stored.file, stored.description
        self._restore_pins(trainer, stored)
        for note in trainer.notes(description):
            self._tell("warning", note)
        self._saved = path, description["step"]
        if self.settings.method not in ("auto", trainer.method_name):
            text = phrase(
                "{file} holds a model of method {method}: --method {asked} is not used",
                file=path.name,
                method=trainer.method_name,
                asked=self.settings.method,
            )
            self._tell("warning", text)
        text = phrase("loaded {file}: step {step:,}", file=path.name, step=description["step"])
        self._tell("info", text, path, kind="loaded")

    def _restore_pins(self, trainer: Trainer, stored: Stored) -> None:
        pins: list[messages.Pin] = []
        try:
            pins = pin_files.restored_pins(stored.description, self.artist.open_rays())
            pins = pin_files.with_histories(pins, stored.description, stored.state)
        except UserError as error:
            self._tell("warning", str(error))
        self.artist.pins.replace(pins, trainer)
        self.artist.pins.record(trainer)

    @property
    def saved_step(self) -> int:
        """See `messages.Snapshot`."""
        return self._saved[1] if self._saved is not None and os.path.exists(self._saved[0]) else 0

    def _save_unsaved(self, file: Path | None, folder: Path | None) -> None:
        if self.trainer is None or self.trainer.step_count <= self.saved_step:
            return
        scene = self.need_scene()
        named = None if folder is None else folder / checkpoint_name(scene)
        self._save([*filter(None, [file, named]), *spare_files(scene)], named)

    def _save(self, files: Sequence[Path], numbered: Path | None = None) -> None:
        """Write to the first file that can be written. numbered: the one that gets a number if there is one already."""
        trainer, pins = self.need_trainer(), list(self.artist.pins)
        description = trainer.describe() | pin_files.described(pins)
        tensors = trainer.state() | pin_files.tensors(pins)
        shown = self.artist.preview(None)

        def write(file: Path) -> Path:
            own = left_off(file, self.capture, self.settings.load)
            small = small_picture(file, None if shown is None else shown.rgba)
            return checkpoint.save(file, description | own, tensors | small, numbered=file == numbered)

        path, reasons = save_somewhere(files, write)
        self._saved = path, trainer.step_count
        for reason in reasons:
            self._tell("warning", reason)
        text = phrase("saved step {step:,} to {file}", step=trainer.step_count, file=str(path.absolute()))
        self._tell("info", text, path, kind="saved")

    def _export_rays(self, path: Path, axis: AxisChoice) -> None:
        check_format(path)
        shown = [pin for pin in self.artist.pins if not pin.hidden]
        write_inspection(self.artist.ray.whole(self.need_trainer(), shown), path, axis)
        self._tell("info", phrase("wrote {file}", file=str(path)), path, kind="wrote")

    # ---- training ---------------------------------------------------------------------------------------------------

    @property
    def training(self) -> bool:
        return self.until is not None

    def train(self, steps: int | None, seconds: float | None) -> None:
        """See `messages.Train`."""
        trainer = self.need_trainer()
        if steps is not None and steps < 1:
            raise UserError(f"training for {steps} steps: give at least 1")
        if seconds is not None and not seconds > 0:
            raise UserError(f"training for {seconds:g} seconds: give more than 0")
        if not trainer.total_steps:
            self._tell("info", nothing_to_train(trainer.method_name))
            return
        if steps is None and trainer.step_count >= trainer.total_steps:
            text = phrases(
                "the one step of the schedule is done", "all {n:,} steps of the schedule are done", trainer.total_steps
            )
            self._tell("info", text)
            return
        self.failed, self.skipped = False, None
        self._until_seconds = math.inf if seconds is None else trainer.seconds + seconds
        self._limited = steps is not None or seconds is not None
        self.until = trainer.total_steps if steps is None else trainer.step_count + steps

    def seconds_left(self, rays_per_second: float) -> float | None:
        """Return how long training goes on at this rate; None if that is unknown, or nobody said when it ends.

        All the steps of a schedule are more than anybody needs to wait for.
        """
        if self.trainer is None or self.until is None or not self._limited or not rays_per_second:
            return None
        by_steps = (self.until - self.trainer.step_count) * self.rays_per_step / rays_per_second
        return max(0.0, min(by_steps, self._until_seconds - self.trainer.seconds))

    def pause(self) -> None:
        self.until = None
        if self.trainer is not None:
            self.trainer.method.rest()
            give_back()

    def fail(self, view: ViewRequest | None) -> None:
        """Pause after a fault of the program. view: what was being drawn; it is not tried again."""
        self.until, self.failed, self.skipped = None, True, view

    def pause_if_done(self) -> None:
        """Pause if the steps or seconds that were asked for are done."""
        trainer, end = self.trainer, self.until
        if trainer is None or end is None:
            return
        if trainer.step_count >= end or trainer.seconds >= self._until_seconds:
            self.pause()

    def tell_of_photos(self) -> None:
        """Tell once when all photos of a large capture are read, and which of them are damaged."""
        filling = None if self.scene is None else self.scene.photos.filling
        if filling is None or self._told_of == self.loaded or not filling.state.all():
            return
        self._told_of = self.loaded
        self._tell("info", phrase("all {n:,} photos are read", n=len(filling.state)))
        for note in damage_notes(filling.damaged()):
            self._tell("warning", note)

    def step(self, yield_callback: Callable[[], None]) -> Report | None:
        """Do one training step; return None if the loss diverged, after the last good weights were restored.

        Raises UserError when the device has no memory left, and PhotosLost. What `yield_callback` raises abandons the
        step.
        """
        trainer = self.need_trainer()
        try:
            if torch.get_num_threads() != trainer.threads:  # sums depend on it, and another run may have its own
                torch.set_num_threads(trainer.threads)
            report = trainer.step(yield_callback)
            if self._good is not None and self._good.due():
                self._good.remember(trainer)
        except Diverged as error:
            self._recover(trainer, error)
            return None
        except PhotosLost:
            self.until, self.failed = None, True
            raise
        except torch.OutOfMemoryError as error:
            self.pause()
            raise UserError(
                f"out of device memory: {error}; use a smaller step: --set rays, samples or chunk_rays"
            ) from None
        self.rays_per_step = report.rays
        if report.note:
            self._tell("warning", report.note)
        return report

    def _recover(self, trainer: Trainer, error: Diverged) -> None:
        """Return to the last weights that are known to be good, and pause."""
        self.failed = True
        self.pause()
        if self._good is not None:
            self._good.restore(trainer)
            self.artist.pins.rewind(trainer.step_count)
            if self._saved is not None:
                self._saved = self._saved[0], min(self._saved[1], trainer.step_count)
        self.artist.forget_pictures()
        text = phrase("{error}; back at step {step:,}, paused", error=str(error), step=trainer.step_count)
        self._tell("error", text, kind="failed")

    # ---- pictures ---------------------------------------------------------------------------------------------------

    def draw(self, view: ViewRequest | None) -> bool:
        """Do one piece of a ray or of the picture, of at most some 15 ms; return whether there was any."""
        trainer, asked = self.need_trainer(), self.artist.ray.asked
        try:
            with enough_memory():
                if self.artist.draw_rays(trainer, view, self.training):
                    return True
        except UserError as error:
            if self.artist.ray.asked is asked:  # a pin
                raise
            self._tell("error", str(error), kind="failed", command=self._ray_command)
            return True
        if view is None:
            return False
        try:
            with enough_memory():
                return self.artist.draw_view(trainer, view, self.training)
        except UserError:  # a mode that the method cannot draw, say: reported once, not at every turn
            self.skipped = view
            raise

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def _tell(
        self,
        level: messages.Level,
        text: str,
        path: Path | None = None,
        kind: messages.Kind = "note",
        command: int = 0,
    ) -> None:
        self._tell_worker(Notice(level, text, path, kind=kind, command=command, run=self.number))

    @contextmanager
    def _busy(self, words: str) -> Iterator[None]:
        try:
            if words:
                self._busy_with(words)
            yield
        finally:
            self.loading, self.posing = "", None

    def _busy_with(self, words: str, now: bool = True) -> None:
        self.loading = printable(words)
        self._say_loading(now)

    def close(self) -> None:
        """Remove half-written files."""
        self.exports.abort()
