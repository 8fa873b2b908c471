"""What a step of a tour waits for: conditions that are read from the window's state. An addition is one function."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerf_core.common.errors import shorten
from nerf_core.lab.study import STUDIES
from nerf_core.rendering.export.requests import Export
from nerf_core.rendering.modes import mode_names

from ..model.state import AppState
from ..ui.contract import PANELS

WIGGLE = 1e-6  # a camera that moved by less, in scene units or in a rotation's entries, was not moved by the reader


@dataclass(frozen=True)
class Before:
    """How things were when the step had been shown and its deeds were done.

    pose: (3, 4) the camera's pose.
    view: the photo whose camera it was; None: none.
    ray: the id of the ray that was open; 0: none.
    export: the newest one, or None.
    hand: how often the ray by hand had been changed.
    """

    pose: np.ndarray
    view: int | None
    ray: int
    export: Export | None
    hand: int


Holds = Callable[[AppState, Before], bool]


@dataclass(frozen=True)
class Condition:
    """Something that holds or does not. words: as the step writes it."""

    words: str
    holds: Holds


def condition(text: str) -> Condition:
    """Return the condition that a text names. Raises ValueError with what to write."""
    kind, *words = text.split() or [""]
    if kind not in CONDITIONS:
        raise ValueError(f"choose of {', '.join(CONDITIONS)}")
    return Condition(text, CONDITIONS[kind](words))


def before(state: AppState) -> Before:
    """Return how things are now."""
    ray = state.inspect.id if state.inspect is not None else 0
    return Before(state.camera.c2w(), state.current_view, ray, state.snapshot.export, state.hand_changes)


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shorten(text)} is no {what}")
    return value


def _none(words: Sequence[str]) -> None:
    if words:
        raise ValueError("takes no words")


def _one(words: Sequence[str], what: str) -> str:
    if len(words) != 1:
        raise ValueError(f"give {what}")
    return words[0]


def _opened(words: Sequence[str]) -> Holds:
    """`opened`: the reader opened a ray; `opened near X Y Z R`: one that passes a point of the capture within R."""
    if not words:
        return _new_ray
    if len(words) != 5 or words[0] != "near":
        raise ValueError("write opened, or opened near X Y Z R")
    *point, radius = (_number(word, "number") for word in words[1:])
    if radius <= 0:
        raise ValueError("the radius R is greater than 0")

    def near(state: AppState, begun: Before) -> bool:
        ray, scene = state.snapshot.ray, state.snapshot.scene
        if ray is None or scene is None or not _new_ray(state, begun):
            return False
        to_input = np.asarray(scene.to_input, np.float64)
        at = np.linalg.solve(to_input, np.array([*point, 1.0]))[:3]
        unit = np.linalg.norm(np.linalg.solve(to_input, np.array([radius, 0, 0, 0.0]))[:3])
        off = at - ray.origin
        along = float(off @ ray.direction)
        return along > 0 and bool(np.linalg.norm(off - along * ray.direction) <= unit)

    return near


def _new_ray(state: AppState, begun: Before) -> bool:
    asked = state.inspect
    return asked is not None and asked.id != begun.ray and state.snapshot.opened_id == asked.id


def _pins(words: Sequence[str]) -> Holds:
    """`pins N`: at least so many rays are pinned."""
    count = _number(_one(words, "a number"), "number")
    return lambda state, _: len(state.snapshot.pins) >= count


def _mode(words: Sequence[str]) -> Holds:
    """`mode NAME`: the viewport shows this render mode."""
    name = _one(words, "a render mode")
    if name not in mode_names():
        raise ValueError(f"choose of {', '.join(mode_names())}")
    return lambda state, _: state.mode == name


def _step(words: Sequence[str]) -> Holds:
    """`step N`: so many training steps are done."""
    count = _number(_one(words, "a number"), "number")
    return lambda state, _: state.snapshot.step >= count


def _psnr(words: Sequence[str]) -> Holds:
    """`psnr X`: the newest PSNR of training is at least X dB."""
    least = _number(_one(words, "a number of dB"), "number")

    def reached(state: AppState, _: Before) -> bool:
        psnr = state.snapshot.history.psnr
        return len(psnr) > 0 and float(psnr[-20:].mean()) >= least

    return reached


def _panel(words: Sequence[str]) -> Holds:
    """`panel TITLE`: this panel is in front."""
    title = panel_title(" ".join(words))
    return lambda state, _: title in state.in_front


def panel_title(text: str) -> str:
    """Return the title of a panel. Raises ValueError if there is none with it."""
    panels = [PANELS.get(name)() for name in PANELS.names()]
    titles = sorted(panel.title for panel in panels if panel.dock != "overlay")
    if text not in titles:
        raise ValueError(f"choose of {', '.join(titles)}")
    return text


def _moved(words: Sequence[str]) -> Holds:
    """`moved`: the reader moved the camera."""
    _none(words)

    def moved(state: AppState, begun: Before) -> bool:
        if state.camera.flying or state.current_view is not None:  # a photo's camera is none of the reader's
            return False
        return bool(np.abs(state.camera.c2w() - begun.pose).max() > WIGGLE)

    return moved


def _study(words: Sequence[str]) -> Holds:
    """`study NAME`: this study runs, or is done."""
    name = _one(words, "a study")
    if name not in STUDIES.names():
        raise ValueError(f"choose of {', '.join(STUDIES.names())}")

    def runs(state: AppState, _: Before) -> bool:
        study = state.snapshot.study
        return study is not None and study.name == name and study.state in ("running", "done")

    return runs


def _exported(words: Sequence[str]) -> Holds:
    """`exported`: a film or a picture was written since the step was shown."""
    _none(words)

    def done(state: AppState, begun: Before) -> bool:
        export = state.snapshot.export
        return export is not None and export.state == "done" and export is not begun.export

    return done


def _plain(holds: Holds) -> Callable[[Sequence[str]], Holds]:
    def make(words: Sequence[str]) -> Holds:
        _none(words)
        return holds

    return make


# By the first word after @until; docs/tours.md lists them.
CONDITIONS: dict[str, Callable[[Sequence[str]], Holds]] = {
    "opened": _opened,
    "pointed": _plain(lambda state, _: state.sample is not None),
    "pins": _pins,
    "mode": _mode,
    "step": _step,
    "psnr": _psnr,
    "panel": _panel,
    "training": _plain(lambda state, _: state.snapshot.status == "training"),
    "paused": _plain(lambda state, _: state.snapshot.status in ("paused", "finished")),
    "moved": _moved,
    "photo": _plain(lambda state, begun: state.current_view not in (None, begun.view)),
    "study": _study,
    "exported": _exported,
    "hand": _plain(lambda state, begun: state.hand_changes > begun.hand),
}
