"""What pages about one study share: what begins, stops and continues it, what its sliders want, and its folders."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from nerf_core.common.language import tr
from nerf_core.lab.records import Knob, StudyState
from nerf_core.lab.study import STUDIES, Turnable
from nerf_core.live.messages import CancelStudy, Snapshot, StartStudy

from ..model.state import Action
from .contract import Ui
from .widgets import button, hint


class StudyPage:
    """One study on a page of its own.

    study: the newest one, if it is of the page's kind.
    obstacle: why none can begin now, in the window's language; empty: one can.
    values: of sliders, by knob, where they differ from the study's knobs.
    begun: the newest study that this page asked for.
    photo: what the next one learns; None: what the program comes with.
    folders: where studies work.
    """

    def __init__(self, name: str, mark: str, options: Mapping[str, str]) -> None:
        """Prepare it.

        Args:
            name: of the study, in `STUDIES`.
            mark: what the marks of the page's widgets begin with.
            options: by knob that has a slider: the study's option.
        """
        self.study: StudyState | None = None
        self.obstacle = ""
        self.values: dict[str, float] = {}
        self.begun: StartStudy | None = None
        self.photo: Path | None = None
        self.folders = StudyFolders(mark)
        self._name, self._mark, self._options = name, mark, options
        self._problem = ""
        self._known: dict[str, float] = {}  # the study's knobs when sliders were last set to them
        self._folder: Path | None = None  # of that study

    def look(self, snapshot: Snapshot) -> StudyState | None:
        """Take the newest state, and return `study`."""
        newest = snapshot.study
        self.study = newest if newest is not None and newest.name == self._name else None
        if self.study is not None and self.study.folder != self._folder:
            self._folder = self.study.folder
            self._known.clear()  # the Lab or a tour may have begun it
        self.obstacle = ""
        if newest is not None and newest.name != self._name and newest.state == "running":
            text = tr(
                "The study “{name}” is running, and there is one at a time: wait for it, or cancel it in the Lab."
            )
            self.obstacle = text.format(name=tr(STUDIES.get(newest.name).title))
        return self.study

    @property
    def running(self) -> bool:
        return self.study is not None and self.study.state == "running"

    def knobs(self) -> tuple[Knob, ...]:
        """Return the knobs that have sliders, with their values: the study's, or those that it would begin with."""
        kind = STUDIES.get(self._name)()
        usual = kind.knobs() if isinstance(kind, Turnable) else ()
        knobs = self.study.knobs if self.study is not None and self.study.knobs else usual
        return tuple(knob for knob in knobs if knob.name in self._options)

    def learnt(self) -> dict[str, float]:
        """Return, by knob, what the study learns with: what is said about its pictures."""
        return {knob.name: knob.value for knob in self.knobs()}

    def wanted(self) -> dict[str, float]:
        """Return, by knob, what the sliders show."""
        return self.learnt() | self.values

    # ---- what is done -----------------------------------------------------------------------------------------------

    def begin(self) -> Iterator[Action]:
        """Begin with what the sliders say, in place of what runs."""
        try:
            folder = self.folders.fresh(self.study.folder if self.study is not None else None)
        except OSError as error:
            self._problem = str(error)
            return
        if self.running:
            yield CancelStudy()
        options = {self._options[name]: f"{value:.6g}" for name, value in self.wanted().items()}
        self.begun, self._problem = StartStudy(self._name, options, folder, self.photo), ""
        yield self.begun

    def let_go(self, knob: Knob, value: float) -> Iterator[Action]:
        """Do what a slider asks for that is let go where no study runs: one that has ended begins again with it."""
        if self.study is not None and not self.running and value != knob.value:
            yield from self.begin()

    def settle(self, knob: Knob, dragged: bool) -> None:
        """Set a slider to its knob where that was turned, here or in the Lab. dragged: it is still being dragged."""
        if not dragged and self._known.get(knob.name) != knob.value:
            self._known[knob.name] = knob.value
            self.values.pop(knob.name, None)

    # ---- widgets ----------------------------------------------------------------------------------------------------

    def buttons(self, ui: Ui) -> Iterator[Action]:
        """Draw what begins, stops and continues the study."""
        restart, free = icons.ICON_FA_ROTATE_LEFT, not self.obstacle
        tip, again = self.obstacle or tr("Training and the window go on meanwhile."), tr("Begin again")
        if self.study is None:
            if button(ui, f"{icons.ICON_FA_PLAY}  {tr('Start')}", f"{self._mark}.start", enabled=free, tip=tip):
                yield from self.begin()
            return
        if self.study.state == "running":
            kept = tr("What is learnt is kept: you can go on from there.")
            if button(ui, f"{icons.ICON_FA_STOP}  {tr('Stop')}", f"{self._mark}.stop", tip=kept):
                yield CancelStudy()
        elif self.study.state == "cancelled" and self.begun is not None and self.begun.folder == self.study.folder:
            if button(ui, f"{icons.ICON_FA_PLAY}  {tr('Go on')}", f"{self._mark}.go_on", enabled=free, tip=tip):
                yield self.begun
        else:
            if button(ui, f"{restart}  {again}", f"{self._mark}.again", enabled=free, tip=tip):
                yield from self.begin()
            return
        imgui.same_line()
        if button(ui, restart, f"{self._mark}.again", enabled=free, tip=self.obstacle or again):
            yield from self.begin()

    def remarks(self, ui: Ui) -> None:
        """Say why none can begin, and what went wrong."""
        if self.obstacle or self._problem:
            hint(ui, self.obstacle or self._problem, ui.theme.warning)
        study = self.study
        wrong = next((row.text for row in study.rows if row.state == "failed"), "") if study is not None else ""
        if wrong or (study is not None and study.state == "failed"):
            hint(ui, tr(wrong) if wrong else tr("The study failed: see Notices."), ui.theme.error)


class StudyFolders:
    """Folders for studies, in a temporary folder that goes when the page does: a page is for playing.

    The Lab panel and `nerf-core lab` write results to keep.
    """

    def __init__(self, name: str) -> None:
        """name: of the page, in the name of the temporary folder."""
        self._name = name
        self._home: Path | None = None
        self._studies: list[Path] = []

    def fresh(self, current: Path | None) -> Path:
        """Make a folder for a study, and delete those that no study can need any more. Raises OSError.

        current: the folder of the newest study that is known to have begun. Studies begin one after the other, so those
            before it have ended. It and those after it may still be at work. None, or another folder: all stay.
        """
        if current in self._studies:
            ended = self._studies.index(current)
            for folder in self._studies[:ended]:
                shutil.rmtree(folder, ignore_errors=True)
            del self._studies[:ended]
        folder = self.kept("study")
        self._studies.append(folder)
        return folder

    def kept(self, name: str) -> Path:
        """Make a folder that stays as long as the page. Raises OSError. name: what its name begins with."""
        if self._home is None:
            self._home = Path(tempfile.mkdtemp(prefix=f"nerf-viewer-{self._name}-"))
            weakref.finalize(self, shutil.rmtree, self._home, ignore_errors=True)  # at the latest when Python ends
        return Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._home))
