"""One sitting: a window or its offscreen stand-in, the worker behind it, and what was asked for on the command line."""

from __future__ import annotations

import glob
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import platformdirs

from nerf_core.common.errors import UserError
from nerf_core.common.signals import Signals
from nerf_core.datasets.capture import DATASETS
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import CancelExport, Notice, SaveCheckpoint, Train
from nerf_core.live.worker import Worker
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings

from ..app.app import App
from ..model.state import unsaved_steps
from ..window import Window
from .script import Closed, Script
from .wishes import Wishes

APP = "nerf-viewer"
UNATTENDED_SECONDS = 60.0  # how long an offscreen run trains when nobody said how long
UNATTENDED_ORBIT_SECONDS = 120.0  # and about how long it draws an orbit that nobody named
KEPT = 10  # autosaves of one scene
SAVE_SECONDS = 4.0  # what a closing session may spend on saving; whoever sent SIGTERM soon sends SIGKILL
PATIENT_SECONDS = 60.0  # and where a hand closed the window


@dataclass
class Session:
    """Runs once. `autosave` is where a closing window leaves the weights that nobody saved."""

    window: Window
    settings: RunSettings
    signals: Signals
    say: Callable[[str], None]

    def __post_init__(self) -> None:
        self.worker = Worker(self.settings, wake=self.window.wake)
        layout = Path(platformdirs.user_config_dir(APP)) / "layout.ini" if self.window.has_display else None
        self.app = App(self.window, self.worker, layout_file=layout)
        # --format is about the capture it was given with; another is recognised by its content
        self.app.state.settings = replace(self.settings, load=replace(self.settings.load, format="auto"))
        self.worker.start()
        self.signals.be_polite()

    def run(self, data: Path | None, wishes: Wishes) -> int:
        """The wishes, then (in a window that was asked for no files) the user; returns the exit status."""
        script = Script(self.app, self.worker, wishes, lambda: self.signals.received is not None, self.say)
        try:
            script.open(data, self.settings)
            script.prepare()
            if self.window.has_display and not wishes.any_file():
                self._attend(wishes)
            else:
                script.run()
        except Closed:
            self._save_unsaved(wishes.save)
            return 128 + (self.signals.received or signal.SIGINT)
        except Exception:  # a fault of ours, or a file that cannot be written, must not cost what was trained
            self._save_unsaved(None)
            raise
        if not wishes.any_file():
            self._save_unsaved(wishes.save)
        return 128 + self.signals.received if self.signals.received else 0

    def _attend(self, wishes: Wishes) -> None:
        """Start training, and follow the user's hand until the window closes."""
        for problem in (*METHODS.problems, *DATASETS.problems):
            self.app.tell(Notice("warning", problem))
        left = None if wishes.steps is None else wishes.steps - self.worker.snapshot().step
        if left is None or left > 0:
            self.worker.send(Train(left, wishes.seconds))
        self.app.run(lambda: self.signals.received is not None)

    def _save_unsaved(self, asked: Path | None) -> None:
        """Weights are hours of work: a closing session leaves them where it was told to, else with the user's data."""
        snapshot = self.worker.snapshot()
        if snapshot.scene is None or not unsaved_steps(snapshot):
            return
        path = asked or autosave_path(snapshot.scene)
        self.worker.send(CancelExport())
        self.worker.send(SaveCheckpoint(path))
        begin = time.monotonic()
        while not self.worker.stop(0.2):
            if time.monotonic() - begin > (SAVE_SECONDS if self.signals.received else PATIENT_SECONDS):
                break
        if self.worker.snapshot().saved_step < snapshot.step or not path.is_file():
            print(f"{APP}: step {snapshot.step:,} could not be saved in time", file=sys.stderr)
        else:
            self.say(f"saved to {path}; continue with --load {path}")

    def close(self) -> None:
        """Free what the session holds; a worker that cannot end is left to `viewer.cli.command`."""
        self.worker.stop(SAVE_SECONDS)
        self.app.close()
        self.window.close()


def autosave_path(scene: Scene) -> Path:
    """A file that no earlier session's weights lie in; of those, the newest few of each scene are kept."""
    folder = Path(platformdirs.user_data_dir(APP)) / "autosave"
    name = f"{scene.name}-{scene.identity()[:8]}"
    with suppress(OSError):
        for old in sorted(folder.glob(f"{glob.escape(name)}-*.safetensors"))[: 1 - KEPT]:  # names sort by time
            old.unlink()
    return folder / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.safetensors"


def unattended(wishes: Wishes) -> Wishes:
    """What an offscreen run does when it was not told: a minute of training; a picture, a film and one ray."""
    if wishes.load is None and wishes.steps is None and wishes.seconds is None:
        wishes = replace(wishes, seconds=UNATTENDED_SECONDS)
    if not wishes.any_file():
        folder = Path.cwd() / time.strftime("nerf-viewer-%Y%m%d-%H%M%S")
        print(f"training first, then a screenshot, an orbit and the inspection of one ray go to {folder}")
        wishes = replace(
            wishes,
            clicks=wishes.clicks or (("0.5", "0.5"),),
            screenshot=folder / "screenshot.png",
            orbit=folder / "orbit.mp4",
            orbit_seconds=UNATTENDED_ORBIT_SECONDS,
            inspect=(folder / "ray.json",),
        )
    return wishes


def parse_size(text: str) -> tuple[int, int]:
    """ "1440x900" → (1440, 900). Raises UserError."""
    width, x, height = text.lower().partition("x")
    if not (x and (width + height).isascii() and width.isdigit() and height.isdigit()) or not all(
        16 <= int(v) <= 16384 for v in (width, height)
    ):
        raise UserError(f"--size {text}: write WIDTHxHEIGHT in pixels, 16 to 16384 each, as in --size 1280x800")
    return int(width), int(height)
