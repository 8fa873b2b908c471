"""One session: a window or an offscreen one, the worker behind it, and the wishes of the command line."""

from __future__ import annotations

import shlex
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import platformdirs

from nerf_core.captures.records import PLACED
from nerf_core.common.errors import UserError
from nerf_core.common.files import clear_leftovers
from nerf_core.common.output import complain
from nerf_core.common.signals import Interrupted, Signals
from nerf_core.live.messages import CancelExport, SaveUnsaved, Train
from nerf_core.live.worker import Worker
from nerf_core.training.autosaves import any_autosave, clear_spare_leftovers, forget_old_autosaves
from nerf_core.training.last_save import telling
from nerf_core.training.options import loading_words
from nerf_core.training.settings import RunSettings

from ..app.app import App
from ..model.state import TourWish, unsaved_steps
from ..window import Window
from .rescue import Rescue
from .script import Closed, Script
from .wishes import Wishes

APP = "nerf-viewer"
UNATTENDED_SECONDS = 60.0  # training time of an offscreen run without --steps or --seconds
UNATTENDED_ORBIT_SECONDS = 120.0  # about how long it takes to draw its orbit
KEPT = 3  # autosaves of one scene, the newest: besides, the one that was trained the longest
CLOSE_SECONDS = 4.0  # a worker that has nothing to save ends sooner, unless it is in the middle of a huge step


@dataclass
class Session:
    """A session. It runs once, and when it closes it saves weights that are not saved yet.

    language: the code of the window's language; empty: the one that was chosen last in it, else English.
    """

    window: Window
    settings: RunSettings
    signals: Signals
    say: Callable[[str], None]
    language: str = ""

    def __post_init__(self) -> None:
        self.worker = Worker(self.settings, wake=self.window.wake)
        layout = Path(platformdirs.user_config_dir(APP)) / "layout.ini" if self.window.has_display else None
        self.app = App(self.window, self.worker, layout_file=layout, language=self.language)
        # --format is for the capture on the command line; later ones are recognised by their content
        self.app.state.settings = replace(self.settings, load=replace(self.settings.load, format="auto"))
        self._asked: Path | None = None  # the file of --save
        self._patience = CLOSE_SECONDS  # limit for the worker's end when nothing is to be saved
        self._rescue = Rescue(lambda: self._save_unsaved(self._asked))
        self.window.when_lost(self._rescue.lost)
        clear_spare_leftovers()
        self.worker.start()
        self.signals.be_polite()

    def run(self, data: Path | None, wishes: Wishes) -> int:
        """Fulfil the wishes, then, in a window without requested files, serve the user. Returns the exit status."""
        script = Script(self.app, self.worker, wishes, lambda: self.signals.received is not None, self.say)
        self._asked = wishes.save
        if wishes.save is not None:
            clear_leftovers(wishes.save.parent)
        status = 2  # of an error
        try:
            status = self._run(script, data, wishes)
            return status
        except Interrupted as error:  # a second signal: whoever sent it does not want to wait for anything
            status, self._patience = error.status, 0.0
            raise
        finally:
            self._rescue.attend()
            self._rescue.closing(status)

    def _run(self, script: Script, data: Path | None, wishes: Wishes) -> int:
        serving = self.window.has_display and not wishes.any_file()
        try:
            unasked = wishes == Wishes() and self.settings == RunSettings() and any_autosave()
            if serving and data is None and (unasked or (wishes.tour is not None and wishes.load is None)):
                self._begin_with(wishes.tour)
                self._rescue.attend()
                self._save_unsaved(None)
                return 128 + self.signals.received if self.signals.received else 0
            try:
                script.open(data, self.settings)
            except UserError as error:
                if not serving:
                    raise
                self._say_in_window(str(error))
                self._rescue.attend()
                self._save_unsaved(wishes.save)  # of what was opened instead
                nothing = self.worker.snapshot().scene is None
                return 128 + self.signals.received if self.signals.received else 2 * nothing
            script.prepare()
            self.app.state.tour = wishes.tour
            if wishes.folder is not None:
                files = "a screenshot, an orbit and the inspection of one ray"
                self.say(f"training first, then {files} go to {wishes.folder}")
            if serving:
                self._attend(wishes)
            else:
                script.run()
        except Closed:
            self._rescue.attend()
            self._save_unsaved(wishes.save)
            return 128 + (self.signals.received or signal.SIGINT)
        except Exception:  # an error, or a file that cannot be written, must not lose what was trained
            self._rescue.attend()
            self._save_unsaved(None)
            raise
        if not wishes.any_file():
            self._rescue.attend()
            self._save_unsaved(wishes.save)
        return 128 + self.signals.received if self.signals.received else 0

    def _begin_with(self, tour: TourWish | None) -> None:
        """Serve the user, who named nothing to open: with a tour, which opens it, else with an offer to continue."""
        if tour is None:
            self.app.state.left_off.read()
            self.app.state.show_left_off = True
        self.app.state.tour = tour
        self.app.run(lambda: self.signals.received is not None)

    def _say_in_window(self, error: str) -> None:
        """Serve the user, with a window that says why the capture was not opened: a launcher shows no terminal."""
        _complain(error)
        self.app.state.not_opened = error
        for shown in self.app.state.notices:
            shown.dismissed = True  # the viewport says it
        self.app.run(lambda: self.signals.received is not None)

    def _attend(self, wishes: Wishes) -> None:
        """Serve the user until the window closes. A capture trains; a loaded checkpoint does if that is asked for.

        The steps of a tour say themselves what trains.
        """
        snapshot = self.worker.snapshot()
        left = None if wishes.steps is None else wishes.steps - snapshot.step
        wanted = wishes.load is None or wishes.steps is not None or wishes.seconds is not None
        nothing = snapshot.scene is not None and not snapshot.total_steps  # the method has no parameters
        if wanted and wishes.tour is None and not nothing and (left is None or left > 0):
            self.worker.send(Train(left, wishes.seconds))
        self.app.run(lambda: self.signals.received is not None)

    def _save_unsaved(self, asked: Path | None) -> None:
        """Save weights that are not saved yet: to the file of --save, else among the user's data, else anywhere.

        It takes as long as it takes: a second signal ends it.
        """
        snapshot = self.worker.snapshot()
        if snapshot.posing is not None and snapshot.posing.stage != PLACED:
            _complain("the search for poses was stopped: nothing of it is kept")
        if snapshot.scene is None or not unsaved_steps(snapshot):
            return
        self.worker.send(CancelExport())
        number = self.worker.send(SaveUnsaved(asked))
        with telling(snapshot.step, _complain, asked=self.signals.received is not None):
            while not self.worker.stop(0.2):
                pass
        snapshot = self.worker.snapshot()  # a scene may have been opened before the worker came to save
        replies = [notice for notice in self.worker.notices() if notice.command == number]
        for notice in replies:
            if notice.kind == "saved":
                self.say(f"saved to {notice.path}; continue with {self._continues(str(notice.path))}")
                if snapshot.scene is not None:
                    forget_old_autosaves(snapshot.scene, KEPT)  # only now, because a save may fail
            else:
                _complain(notice.text)
        if not replies and unsaved_steps(snapshot):
            _complain(f"step {snapshot.step:,} is not saved: the thread that trains has ended before")

    def _continues(self, checkpoint: str) -> str:
        """The command that opens the same scene with a checkpoint, from any folder. The worker has ended."""
        capture, load = self.worker.opened()
        words = [APP, *([] if capture is None else [str(capture)]), *loading_words(load)]
        words += [] if self.settings.device == "auto" else ["--device", self.settings.device]
        return shlex.join([*words, "--load", checkpoint])

    def close(self) -> None:
        """Free what the session holds. A worker that does not end is left to `viewer.cli.command`."""
        self.worker.stop(self._patience)
        self.app.close()
        self.window.close()
        self._rescue.close()


def _complain(text: str) -> None:
    complain(f"{APP}: {text}")


def unattended(wishes: Wishes) -> Wishes:
    """Return the wishes of an offscreen run without any: train a minute, write a picture, an orbit and one ray."""
    if wishes.load is None and wishes.steps is None and wishes.seconds is None:
        wishes = replace(wishes, seconds=UNATTENDED_SECONDS)
    if not wishes.any_file():
        folder = Path.cwd() / time.strftime("nerf-viewer-%Y%m%d-%H%M%S")
        wishes = replace(
            wishes,
            folder=folder,
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
