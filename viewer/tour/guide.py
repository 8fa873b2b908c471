"""Where the reader is in a tour: it performs the steps, notices what is done, and remembers the place."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerf_core.common.assets import assets_dir
from nerf_core.common.errors import UserError
from nerf_core.common.files import write_atomically
from nerf_core.common.language import ENGLISH, language
from nerf_core.live.messages import CancelStudy

from ..model.state import Action, AppState
from .conditions import Before, before
from .deeds import DEMO, Deed, own_study
from .models import Models, wanted
from .steps import Step, read_tour

RESTORED = "settings", "mode", "show_cameras", "show_samples"  # of the state, when the reader leaves
SHIPPED = "shipped"  # the key of the program's own tour in the file that remembers places


def shipped() -> Path:
    """Return the folder of the program's own tour, in the window's language if it is there, else in English."""
    folder = assets_dir() / "tour"
    return own if (own := folder / language()).is_dir() else folder / ENGLISH


class Guide:
    """A tour, on or not. Owned by the GUI thread; a thread of its own reads the files, because that loads PyTorch.

    places: the file that remembers where the reader was; None: nothing is read or written.
    wake: called from the thread when it is done.

    Attributes:
        on: whether a tour is shown.
        steps: its steps; empty while they are read.
        at: the index of the step that is shown.
        ticks: the tasks that were done, by the step's name and the task's number.
        answered: the questions whose answers are shown, likewise by block.
        error: why the tour cannot be shown; empty: it can.
    """

    def __init__(self, places: Path | None = None, wake: Callable[[], None] = lambda: None) -> None:
        self.on = False
        self.steps: tuple[Step, ...] = ()
        self.at = 0
        self.ticks: set[tuple[str, int]] = set()
        self.answered: set[tuple[str, int]] = set()
        self.error = ""
        self._places, self._wake = places, wake
        self._folder: Path | None = None  # of a tour that is not the program's own
        self._language = ""
        self._read = deque[tuple[Step, ...] | str]()  # from the thread: the steps, or what is wrong with them
        self._deeds: deque[Deed] = deque()
        self._before: Before | None = None
        self._models: Models | None = None
        self._scene: str | None = None  # of the steps that name none; None: not known yet
        self._waiting = False  # for a model
        self._stopping = False  # whether a study of another step is being stopped
        self._put_aside = False  # whether a model of the reader's was saved by a tour before this one
        self._last: list[Action] = []  # to be done after the tour has ended
        self._own: dict[str, Any] = {}  # choices of the reader that steps change, while a tour is on

    @property
    def step(self) -> Step | None:
        """Return the step that is shown."""
        return self.steps[self.at] if self.on and self.steps else None

    @property
    def busy(self) -> bool:
        """Return whether something of the step is still to be done, so that frames are needed."""
        return self.on and bool(self._read or (self._deeds and not self._waiting))

    @property
    def stands(self) -> bool:
        """Return whether the step is all there: its deeds are done, and what the reader does is noticed."""
        return self.on and not self._deeds and self._before is not None

    # ---- beginning, turning pages, leaving ----------------------------------------------------------------------

    def begin(self, state: AppState, folder: Path | None = None) -> None:
        """Show a tour where the reader left it. folder: of its steps; None: the program's own tour."""
        if self.on and self.steps and folder == self._folder:
            return
        source = folder or shipped()
        if self._models is None or folder != self._folder:
            self._put_aside |= self._models is not None and self._models.saved
            self._models, self._scene = Models(source), None
        self._own = self._own or {name: getattr(state, name) for name in RESTORED}
        self.on, self._folder, self.steps, self.at, self.error = True, folder, (), 0, ""
        self._before, self._language = None, language()
        self._deeds.clear()
        found = self._read = deque[tuple[Step, ...] | str]()

        def read() -> None:
            try:
                found.append(read_tour(source))
            except Exception as error:  # the window goes on without the tour
                found.append(str(error))
            self._wake()

        threading.Thread(target=read, name="tour", daemon=True).start()

    def go(self, index: int) -> None:
        """Show another step."""
        if self.steps:
            self.at = min(max(index, 0), len(self.steps) - 1)
            self._show()
            self._remember()

    def leave(self, state: AppState) -> None:
        """End the tour. If the reader's own model was put aside, offer to return to it."""
        self.on, state.only_panels, state.page = False, None, ""
        self._deeds.clear()
        for name, value in self._own.items():  # the tour's methods are not for what the reader opens next
            setattr(state, name, value)
        self._own = {}
        self._last = [CancelStudy()] if own_study(state) else []
        if self._put_aside or (self._models is not None and self._models.saved):
            self._put_aside = False
            if self._models is not None:
                self._models.saved = False
            state.left_off.read()
            state.show_left_off = True

    # ---- in each frame --------------------------------------------------------------------------------------------

    def act(self, state: AppState) -> list[Action]:
        """Do what is due: take the files that were read, perform deeds, notice what is done."""
        if not self.on:
            last, self._last = self._last, []
            return last
        self._take()
        if self.steps and self._language != language() and self._folder is None:
            self._reread()
        step = self.step
        state.only_panels = step.panels if step is not None and state.presenter else None
        state.page = step.page if step is not None else ""
        if step is None:
            return []
        actions = [*self._stop_study(state, step), *self._perform(state)]
        if self._deeds or actions:  # what the step itself does is no deed of the reader's
            return actions
        if self._before is None and not state.camera.flying and _settled(step, state):
            self._before = before(state)
        if self._before is not None:
            self._notice(state, step, self._before)
        return actions

    def _reread(self) -> None:
        """Read the steps in another language; the place and the ticks stay, and no deed is done again."""
        self._language = language()
        try:
            steps = read_tour(shipped())
        except UserError as error:
            self.error = str(error)
            return
        if [step.name for step in steps] == [step.name for step in self.steps]:
            self.steps = steps

    def _take(self) -> None:
        while self._read:
            found = self._read.popleft()
            if isinstance(found, str):
                self.error = found
                continue
            self.steps = found
            names = [step.name for step in found]
            name, self.ticks = self._recall()
            self.at = names.index(name) if name in names else 0
            self._show()

    def _show(self) -> None:
        self._deeds = deque(self.steps[self.at].deeds)
        self._before = None

    def _perform(self, state: AppState) -> list[Action]:
        """Open the step's model if another one is open; then do the deeds, as far as they can be done now."""
        assert self._models is not None
        self._waiting = bool(self._deeds) and self._models.waiting(state)
        if self._waiting or not self._deeds:
            return []
        if self._scene is None:  # a tour of the reader's own is about what is open
            self._scene = DEMO if self._folder is None or state.snapshot.scene is None else ""
        opening = self._models.open(state, wanted(self.steps, self.at, self._scene))
        if opening is not None:
            return [opening]
        actions: list[Action] = []
        while self._deeds:
            deed = self._deeds[0]
            if not deed.ready(state) or (deed.panel and state.raise_panel and not state.page):
                break
            self._deeds.popleft()
            actions += deed.do(state)
            if deed.panel:
                break  # one panel a frame
        return actions

    def _stop_study(self, state: AppState, step: Step) -> list[Action]:
        """Stop a study that another step has begun: there is one at a time, and the scene trains beside it."""
        running = own_study(state)
        unfit = bool(running) and all(deed.study != running for deed in step.deeds)
        stop, self._stopping = unfit and not self._stopping, unfit
        return [CancelStudy()] if stop else []

    def _notice(self, state: AppState, step: Step, begun: Before) -> None:
        for number, task in enumerate(step.tasks):
            key = step.name, number
            if key not in self.ticks and task.until is not None and task.until.holds(state, begun):
                self.ticks.add(key)
                self._remember()

    # ---- the place ------------------------------------------------------------------------------------------------

    def _key(self) -> str:
        return SHIPPED if self._folder is None else str(self._folder.absolute())

    def _all_places(self) -> dict[str, Any]:
        if self._places is None:
            return {}
        try:
            found = json.loads(self._places.read_text("utf-8"))
        except (OSError, ValueError):  # what cannot be read is no place; the tour begins at its first step
            return {}
        return found if isinstance(found, dict) else {}

    def _recall(self) -> tuple[str, set[tuple[str, int]]]:
        """Return the name of the step where the reader was, and the ticks; empty if nothing fit is known."""
        place = self._all_places().get(self._key())
        if not isinstance(place, dict):
            return "", set()
        ticks = place.get("ticks")
        pairs = [tick for tick in ticks if isinstance(tick, list) and len(tick) == 2] if isinstance(ticks, list) else []
        return str(place.get("step", "")), {(str(name), int(n)) for name, n in pairs if isinstance(n, int)}

    def _remember(self) -> None:
        if self._places is None or self.step is None:
            return
        place = {"step": self.step.name, "ticks": sorted(map(list, self.ticks))}
        text = json.dumps(self._all_places() | {self._key(): place}, ensure_ascii=False, indent=1)
        try:
            self._places.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._places, text.encode())
        except (OSError, UserError):  # the place is a comfort, and the disk's fault is told where work is saved
            self._places = None


def _settled(step: Step, state: AppState) -> bool:
    """Whether the worker has done what the step asked of it last: until then the state is not the step's."""
    waits = [deed.settled for deed in step.deeds if deed.settled is not None]
    return not waits or waits[-1](state)
