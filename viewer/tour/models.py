"""Which model a step of a tour needs, and how it is opened without losing what the reader has trained."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from nerf_core.live.messages import (
    InOrder,
    LoadCheckpoint,
    OfRun,
    OpenScene,
    SaveCheckpoint,
    SaveUnsaved,
    Train,
    UseMethod,
)

from ..model.state import Action, AppState, unsaved_steps
from .deeds import DEMO
from .steps import Step


class Model(NamedTuple):
    """A model as a tour writes it.

    scene: "demo", or a path from the tour's folder; empty: the one that is open.
    method: empty: any.
    changes: of its constants, as texts by name.
    """

    scene: str = ""
    method: str = ""
    changes: tuple[tuple[str, str], ...] = ()


def wanted(steps: Sequence[Step], at: int, scene: str) -> Model:
    """Return the model of a step: the last `@scene` and `@method` at or before it. scene: where no step names one."""
    found = Model(scene)
    for step in steps[: at + 1]:
        for deed in step.deeds:
            if deed.scene:
                found = found._replace(scene=deed.scene)
            if deed.method:
                found = found._replace(method=deed.method, changes=deed.changes)
    return found


class Models:
    """The models of one tour. What it has trained is kept, so that going back and forth begins nothing anew.

    folder: where the paths of captures begin.

    Attributes:
        saved: whether a model of the reader's was saved because the tour needed another.
    """

    def __init__(self, folder: Path) -> None:
        self.saved = False
        self._folder = folder
        self._last: Model | None = None  # what the tour has asked for last
        self._ours: _Opened | None = None  # what was opened when the tour's own model was; None: it was not
        self._asked: _Opened | None = None  # what was opened when a model was asked for that is not there yet
        self._kept: dict[Model, Path] = {}  # what the tour itself has trained, in this session
        self._home = ""

    def waiting(self, state: AppState) -> bool:
        """Return whether a model is being opened. It ends with the worker's answer, also if that is a refusal."""
        for shown in state.notices:  # files of the tour's own concern nobody
            shown.dismissed |= shown.notice.path in self._kept.values()
        if state.snapshot.loading:
            return True
        if self._asked is None:
            return False
        now = _Opened.of(state)
        if now == self._asked:
            return True
        self._ours = now if now.scenes_and_models != self._asked.scenes_and_models else None
        self._asked = None
        return False

    def open(self, state: AppState, wanted: Model) -> Action | None:
        """Return the command that opens a model and trains it; None if it is open, or if it was refused before.

        A model of the reader's with steps that are not saved is saved first. If that fails, nothing is opened.
        """
        mine = self._ours is not None and self._ours.scenes_and_models == _Opened.of(state).scenes_and_models
        if wanted == self._last and (mine or self._ours is None):
            return None
        if self._last is None and _will_do(state, wanted):
            return None
        saving: list[OfRun] = []
        if unsaved_steps(state.snapshot):
            if mine and self._last is not None:
                saving.append(SaveCheckpoint(self._file(self._last)))
            else:
                self.saved = True
                saving.append(SaveUnsaved())
        there = self._last.scene if mine and self._last is not None else _scene_of(state)
        self._last, self._asked = wanted, _Opened.of(state)
        return InOrder((*saving, *self._opening(state, wanted, wanted.scene in ("", there))))

    def _opening(self, state: AppState, wanted: Model, same_scene: bool) -> tuple[OfRun, ...]:
        kept, method, changes = self._kept.get(wanted), wanted.method or "auto", dict(wanted.changes)
        if same_scene:
            return (
                (UseMethod(method, train=True, changes=changes),) if kept is None else (LoadCheckpoint(kept), Train())
            )
        load = replace(state.settings.load, format="auto")
        settings = replace(state.settings, load=load, method=method, preset="auto", changes=changes)
        path = None if wanted.scene == DEMO else self._folder / wanted.scene
        return (OpenScene(path, settings, train=True, checkpoint=kept),)

    def _file(self, model: Model) -> Path:
        """The file that keeps a model."""
        if not self._home:
            self._home = tempfile.mkdtemp(prefix="nerf-viewer-tour-")
            weakref.finalize(self, shutil.rmtree, self._home, ignore_errors=True)  # at the latest when Python ends
        return self._kept.setdefault(model, Path(self._home) / f"model-{len(self._kept)}.safetensors")


class _Opened(NamedTuple):
    """How many scenes and models were opened so far, and how many commands have failed."""

    scenes_and_models: tuple[int, int]
    failures: int

    @classmethod
    def of(cls, state: AppState) -> _Opened:
        kinds = [shown.notice.kind for shown in state.notices]
        return cls((state.snapshot.loaded, kinds.count("loaded")), kinds.count("failed"))


def _scene_of(state: AppState) -> str:
    scene = state.snapshot.scene
    return DEMO if scene is not None and scene.format == DEMO else "?"


def _will_do(state: AppState, wanted: Model) -> bool:
    """Whether the reader's own model will do."""
    there = state.snapshot.scene is not None and wanted.scene in ("", _scene_of(state))
    return there and wanted.method in ("", state.snapshot.method) and not wanted.changes
