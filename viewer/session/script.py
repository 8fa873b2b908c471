"""Do what the command line asks, through the app itself: with the same loop, panels and messages as a user."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerf_core.common.console import Display
from nerf_core.common.errors import UserError
from nerf_core.common.text import duration
from nerf_core.geometry.camera_files import picked_camera
from nerf_core.geometry.paths.steps import training_size
from nerf_core.live.messages import (
    MOST_PINS,
    CancelExport,
    Command,
    ExportRays,
    Kind,
    LoadCheckpoint,
    OpenScene,
    Pause,
    PinRay,
    SaveCheckpoint,
    SetShare,
    Snapshot,
    StartExport,
    Train,
)
from nerf_core.live.worker import Worker
from nerf_core.methods import nothing_to_train
from nerf_core.rendering.export.requests import ExportStill
from nerf_core.training.settings import RunSettings

from ..app.app import App
from ..model.state import StartFilmExport
from .wishes import Wishes, coordinate

FRAME_SECONDS = 0.25  # between frames of an offscreen interface that waits, because drawing takes time from training
SHARPEN_SECONDS = 180.0  # a screenshot waits so long for the preview's full resolution
UNWATCHED_SHARE = 0.95  # training's share of the time if nobody watches
SHORT_FRAMES, SHORT_FPS = 40, 20.0  # for an orbit with a time limit
SLOWEST, SMALLEST = (
    100.0,
    32,
)  # rays per second if none was measured; the fewest pixels of a side that still show something


class Closed(Exception):
    """Ctrl-C or SIGTERM came, or the window was closed during a script."""


@dataclass
class Script:
    """Drives an app until all requested files are written. Raises UserError if one cannot be."""

    app: App
    worker: Worker
    wishes: Wishes
    interrupted: Callable[[], bool]
    say: Callable[[str], None]
    _read: int = 0  # how many of the app's notices `_wait` has read

    def open(self, path: Path | None, settings: RunSettings) -> None:
        """Load the capture, and the checkpoint if one was given."""
        with Display("loading") as bar:
            self._do(OpenScene(path, settings), lambda s: s.scene is not None and not s.loading, bar)
        scene = self._snapshot().scene
        assert scene is not None
        for note in scene.notes:
            self.say(f"note: {note}")
        if self.wishes.load is not None:
            self._ask(LoadCheckpoint(self.wishes.load), "loaded")

    def run(self) -> None:
        """Train, save and click, then write the files, the quickest first."""
        wishes = self.wishes
        if wishes.steps or wishes.seconds:
            self._train(wishes.steps, wishes.seconds)
        if wishes.save is not None:
            self._ask(SaveCheckpoint(wishes.save), "saved")
        self._uncover()
        for x, y in wishes.clicks:
            self._click(x, y)
        for file in wishes.inspect:
            self._inspect(file)
        if wishes.screenshot is not None:
            self._sharpen()
            self._uncover()
            self.app.screenshot(wishes.screenshot)
        if wishes.render is not None:
            camera = self.app.state.camera.camera(*self.app.state.viewport)
            still = ExportStill(camera, wishes.render, self.app.state.mode)
            self._export(StartExport(still), f"rendering {camera.width}×{camera.height}")
        if wishes.orbit is not None:
            self._film(wishes.orbit, wishes.orbit_seconds)
        for file in wishes.files():
            if not file.is_file():
                raise UserError(f"{file}: was not written")
            self.say(f"wrote {file}")

    # ---- pieces ---------------------------------------------------------------------------------------------------

    def _train(self, steps: int | None, seconds: float | None) -> None:
        start = self._snapshot()
        if not start.total_steps:
            self.say(nothing_to_train(start.method))
            return
        left = None if steps is None else max(steps - start.step, 0)
        if left == 0:
            self.say(f"no training: step {start.step:,} is past --steps {steps:,} already")
            return
        if steps is None and start.step >= start.total_steps:
            self.say(f"no training: all {start.total_steps:,} steps of the schedule are done")
            return
        share, watched = start.wanted_share, self.app.state.has_display
        if not watched:
            self.worker.send(SetShare(UNWATCHED_SHARE))
        self.worker.send(Train(left, seconds))
        rate = 0.0
        with Display("training") as bar:

            def done(s: Snapshot) -> bool:
                nonlocal rate
                rate = s.rays_per_second or rate
                parts = [0.0]
                if left:
                    parts.append((s.step - start.step) / left)
                if seconds:
                    parts.append((s.seconds - start.seconds) / seconds)
                psnr = f"{s.history.psnr[-20:].mean():.1f} dB" if len(s.history.psnr) else ""
                bar.show(min(max(parts), 1.0), f"step {s.step:,}  {s.rays_per_second:,.0f} rays/s  {psnr}")
                return s.step > start.step and s.status in ("paused", "finished")

            try:
                self._wait(done)
            except Closed:
                self.worker.send(Pause())
                raise
        if not watched:
            self.worker.send(SetShare(share))
        s = self._snapshot()
        trained = s.seconds - start.seconds
        self.say(f"trained to step {s.step:,} in {trained:.1f} s of training, {rate:,.0f} rays/s")

    def _uncover(self) -> None:
        """Remove the notices from the viewport. They are printed anyway, and a click must not hit one."""
        for shown in self.app.state.notices:
            shown.dismissed = True
        self.app.settle()

    def prepare(self) -> None:
        """Set camera and mode before training, and pin rays, so that their histories begin at the first step.

        Raises UserError for pins and clicks that miss the viewport, before time is spent on training.
        """
        state, scene = self.app.state, self._snapshot().scene
        state.mode, state.axis = self.wishes.mode, self.wishes.axis
        if self.wishes.camera:
            assert scene is not None
            state.camera.go_to(picked_camera(scene, self.wishes.camera))
            self._wait(lambda _: not state.camera.flying)
        self._uncover()
        self._check_room()
        for x, y in self.wishes.pins:
            _, _, column, row = self._place("pin", x, y)
            camera = state.camera.camera(*state.viewport)
            self.app.perform(PinRay(camera, (column, row)))
        for x, y in self.wishes.clicks:
            self._place("click", x, y)

    def _check_room(self) -> None:
        """Raise UserError if there are too many pins. The demo's own pins give way to --pin; the user's do not."""
        from nerf_core.live.pins import spare_pins  # with torch, which is loaded by now

        snapshot, asked = self._snapshot(), len(self.wishes.pins)
        spare = spare_pins(snapshot.pins, snapshot.scene) if snapshot.scene else []
        room = MOST_PINS - len(snapshot.pins) + len(spare)
        if asked > room:
            beside = f"beside the rays that are pinned in {self.wishes.load} there is room for {room}"
            raise UserError(f"--pin: given {asked} times; {beside}: leave the others out")

    def _place(self, option: str, x: str, y: str) -> tuple[float, float, int, int]:
        """The viewport's position, and the pixel in it that an option names. Raises UserError."""
        if "viewport" not in self.app.widgets:
            raise UserError(f"--{option} {x} {y}: there is no viewport in so small a window; give a larger --size")
        left, top, right, bottom = self.app.widgets["viewport"]
        return left, top, _position(option, x, right - left, "wide"), _position(option, y, bottom - top, "high")

    def _click(self, x: str, y: str) -> None:
        left, top, column, row = self._place("click", x, y)
        self.app.injector.click(left + column + 0.5, top + row + 0.5)
        asked = self.app.state.inspect
        if asked is None:
            raise UserError(f"--click {x} {y}: hit no pixel of the viewport")
        self._wait(lambda s: s.opened_id == asked.id and s.opened_step == s.step)

    def _inspect(self, file: Path) -> None:
        self._ask(ExportRays(file, self.app.state.axis), "wrote")

    def _film(self, file: Path, seconds: float | None) -> None:
        snapshot, form = self._snapshot(), self.app.state.film
        if seconds is not None and snapshot.scene is not None:
            width, height = training_size(snapshot.scene)
            form.frames, form.fps = SHORT_FRAMES, SHORT_FPS
            speed = max(snapshot.preview_rays_per_second, SLOWEST)
            affordable = speed * seconds / form.frames
            scale = min(math.sqrt(affordable / (width * height)), 1.0)
            form.width, form.height = (max(round(scale * side), SMALLEST) for side in (width, height))
            takes = duration(form.frames * form.width * form.height / speed)
            larger = f"; --orbit FILE writes one in the photos' {width}×{height}" if scale < 1 else ""
            self.say(f"orbit: {form.frames} frames of {form.width}×{form.height}, to take about {takes}{larger}")
        self._export(StartFilmExport(file), "orbit")

    def _export(self, action: Command | StartFilmExport, label: str) -> None:
        before = self._snapshot().export
        self.app.perform(action)
        with Display(label) as bar:

            def done(s: Snapshot) -> bool:
                export = s.export
                if export is None or export is before:
                    return False
                bar.show(export.done / max(export.total, 1), f"{export.file.name}", export.seconds_left)
                return export.state != "running"

            try:
                self._wait(done)
            except Closed:
                self.worker.send(CancelExport())
                raise

    def _sharpen(self) -> None:
        limit = time.monotonic() + SHARPEN_SECONDS
        with Display("sharpening the picture") as bar:

            def sharp(s: Snapshot) -> bool:
                preview = s.preview
                if preview is not None and preview.step == s.step and not self.app.stale:
                    if preview.complete:
                        return True
                    coarser = 2 * preview.stride  # only the level before the current one is certainly complete
                    bar.show(1 / coarser**2, f"on to 1/{preview.stride} resolution")
                return time.monotonic() > limit

            self._wait(sharp)
        s = self._snapshot()
        if s.preview is None or self.app.stale:
            self.say(f"screenshot: there was no picture of this view after {SHARPEN_SECONDS:.0f} s")
        elif not s.preview.complete or s.preview.step != s.step:
            sharp_to = f"1/{s.preview.stride} resolution at step {s.preview.step:,}"
            self.say(f"screenshot: the picture came to {sharp_to} in {SHARPEN_SECONDS:.0f} s")

    # ---- waiting --------------------------------------------------------------------------------------------------

    def _snapshot(self) -> Snapshot:
        return self.app.state.snapshot

    def _ask(self, command: Command, kind: Kind) -> None:
        """Send a command and wait for the notice of this kind that answers it."""
        number = self.app.perform(command)
        notices = self.app.state.notices
        self._wait(lambda _: any(n.notice.command == number and n.notice.kind == kind for n in notices))

    def _do(self, command: Command, done: Callable[[Snapshot], bool], bar: Display | None = None) -> None:
        self.app.perform(command)

        def and_show(s: Snapshot) -> bool:
            if bar is not None and s.loading:
                bar.show(None, s.loading)
            return done(s)

        self._wait(and_show)

    def _wait(self, done: Callable[[Snapshot], bool]) -> None:
        """Run the app's loop until `done`. Raises UserError for an error, and Closed if the user ends it.

        An error counts even if it came before this call, while frames were drawn or an action was performed.
        """
        while True:
            self.app.window.poll(0.02)
            due = self.app.state.time + FRAME_SECONDS <= time.monotonic()
            self.app.frame(force=due and self.app.state.has_display)
            for shown in self.app.state.notices[self._read :]:
                self._read += 1
                if shown.notice.level == "error":
                    raise UserError(shown.notice.text)
            if done(self._snapshot()):
                return
            if self.interrupted() or self.app.window.should_close():
                raise Closed
            if not self.worker.alive:
                raise UserError("the worker ended unexpectedly")


def _position(option: str, text: str, size: float, extent: Literal["wide", "high"]) -> int:
    """The pixel that a coordinate names in a viewport that is `size` pixels wide or high. Raises UserError."""
    value = coordinate(option, text) * (size if "." in text else 1)
    if value > size:
        raise UserError(f"--{option} {text}: outside the viewport, which is {size:.0f} pixels {extent} here")
    return min(int(value), int(size) - 1)
