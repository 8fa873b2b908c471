"""What a step of a tour does when it is shown: directives that become actions. An addition is one function."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import platformdirs

from nerf_core.common.configs import changed
from nerf_core.common.errors import UserError
from nerf_core.geometry.turntable import rotation_from
from nerf_core.lab.study import STUDIES
from nerf_core.live.messages import Inspect, Pause, StartStudy, Train
from nerf_core.methods import METHODS
from nerf_core.rendering.modes import mode_names

from ..commands.registry import commands, run
from ..model.state import Action, AppState, GoToView
from .conditions import panel_title

DEMO = "demo"
KEPT_SECONDS = 7 * 86400.0  # for which the files of a tour's studies stay in the cache
UNFIT = ("File", "Window", "Language", "Help")  # sections of commands that are not for `@do`


@dataclass(frozen=True)
class Deed:
    """Something that is done once the step is shown.

    do: changes the state, and returns what the app or the worker should do.
    panel: the title of the panel that it brings to the front, one a frame; empty: none.
    ready: whether it can be done now.
    settled: whether the worker has done it; None: nothing is to be waited for.
    page: the title of the panel that it shows alone, in the place of the picture and all panels; empty: none.
    study: the name of the study that belongs to the step; empty: none.
    scene: of `@scene`: the capture that this step and the following ones are about.
    method, changes: of `@method`: the model of this step and the following ones.
    """

    do: Callable[[AppState], list[Action]] = lambda _: []
    panel: str = ""
    page: str = ""
    study: str = ""
    ready: Callable[[AppState], bool] = lambda _: True
    settled: Callable[[AppState], bool] | None = None
    scene: str = ""
    method: str = ""
    changes: tuple[tuple[str, str], ...] = ()


def _numbers(text: str, least: int, most: int) -> list[float]:
    try:
        found = [float(word) for word in text.split()]
    except ValueError:
        found = []
    if not least <= len(found) <= most or not all(map(math.isfinite, found)):
        many = f"{least}" if least == most else f"{least} to {most}"
        raise ValueError(f"give {many} number{'' if most == 1 else 's'}")
    return found


def _nothing(text: str) -> None:
    if text:
        raise ValueError("takes no words")


def _pairs(words: list[str]) -> tuple[tuple[str, str], ...]:
    pairs = [word.partition("=") for word in words]
    if not all(name and equals and value for name, equals, value in pairs):
        raise ValueError("write options as name=value")
    return tuple((name, value) for name, _, value in pairs)


def _check(constants: Any, pairs: tuple[tuple[str, str], ...], name: str) -> None:
    """Raise ValueError for an option that a method or a study does not have, or whose value does not fit."""
    try:
        changed(constants, dict(pairs), name)
    except UserError as error:
        raise ValueError(str(error).removeprefix("--set ")) from None


def _photo(text: str) -> Deed:
    """`@photo N`: fly to training photo N, from 0."""
    (number,) = _numbers(text, 1, 1)
    if number < 0 or number != int(number):
        raise ValueError("give a whole number from 0")

    def fly(state: AppState) -> list[Action]:
        scene = state.snapshot.scene
        photos = scene.split("train") if scene is not None else ()
        return [GoToView(photos[int(number) % len(photos)])] if photos else []

    return Deed(fly)


def _orbit(text: str) -> Deed:
    """`@orbit AZIMUTH ELEVATION [DISTANCE]`: look at the scene's middle; degrees, and scene radii."""
    azimuth, elevation, *distance = _numbers(text, 2, 3)
    if not -89 <= elevation <= 89 or (distance and distance[0] <= 0):
        raise ValueError("the elevation is between -89 and 89, the distance greater than 0")

    def fly(state: AppState) -> list[Action]:
        scene = state.snapshot.scene
        if scene is not None:
            rotation = rotation_from(math.radians(azimuth), math.radians(elevation), 0.0, np.asarray(scene.up))
            state.camera.look(rotation, distance[0] if distance else None)
            state.current_view = None
        return []

    return Deed(fly)


def _mode(text: str) -> Deed:
    """`@mode NAME`: what the viewport shows of each pixel."""
    if text not in mode_names():
        raise ValueError(f"choose of {', '.join(mode_names())}")

    def show(state: AppState) -> list[Action]:
        state.mode = text
        return []

    return Deed(show)


def _switch(name: str) -> Callable[[str], Deed]:
    def make(text: str) -> Deed:
        if text not in ("on", "off"):
            raise ValueError("write on or off")

        def show(state: AppState) -> list[Action]:
            setattr(state, name, text == "on")
            return []

        return Deed(show)

    return make


def _panel(text: str) -> Deed:
    """`@panel TITLE`: bring a panel to the front."""
    panel_title(text)

    def show(state: AppState) -> list[Action]:
        state.show_panels, state.raise_panel = True, text
        return []

    return Deed(show, panel=text)


def _page(text: str) -> Deed:
    """`@page TITLE`: show a panel alone, as large as the window, while the step is shown."""

    def show(state: AppState) -> list[Action]:
        state.show_panels = True
        return []

    return Deed(show, page=panel_title(text))


def _open(text: str) -> Deed:
    """`@open X Y Z`: open the ray through a point of the capture's own coordinates."""
    point = np.array([*_numbers(text, 3, 3), 1.0])

    def look(state: AppState) -> list[Action]:
        scene = state.snapshot.scene
        if scene is None:
            return []
        width, height = state.viewport
        camera = state.camera.camera(width, height)
        world = np.linalg.solve(np.asarray(scene.to_input, np.float64), point)[:3]
        x, y, z = np.linalg.solve(camera.c2w[:, :3], world - camera.c2w[:, 3])
        if z >= 0:
            return []  # behind the camera
        column = int(camera.cx - camera.fx * x / z)
        row = int(camera.cy + camera.fy * y / z)
        inside = 0 <= column < width and 0 <= row < height
        return [Inspect(camera, (column, row))] if inside else []

    return Deed(look, ready=lambda state: state.snapshot.scene is not None and not state.camera.flying)


def _train(text: str) -> Deed:
    """`@train`: train on, unless all steps are done."""
    _nothing(text)

    def train(state: AppState) -> list[Action]:
        return [Train()] if state.snapshot.status in ("ready", "paused") else []

    return Deed(train, settled=lambda state: state.snapshot.status not in ("ready", "paused"))


def _pause(text: str) -> Deed:
    """`@pause`: pause the training."""
    _nothing(text)
    return Deed(lambda _: [Pause()], settled=lambda state: state.snapshot.status != "training")


def _scene(text: str) -> Deed:
    """`@scene demo` or `@scene PATH`: what this step and the following ones are about; PATH from the tour's folder."""
    if not text:
        raise ValueError("write demo, or the path of a capture")
    for path in (PurePosixPath(text), PureWindowsPath(text)):  # a tour may come from anywhere: it opens its own alone
        if path.is_absolute() or path.anchor or ".." in path.parts:
            raise ValueError("the capture lies in the tour's folder: write a path from there, without ..")
    return Deed(scene=text)


def _method(text: str) -> Deed:
    """`@method NAME [name=value …]`: the model of this step and the following ones."""
    name, *options = text.split() or [""]
    if name not in METHODS.names():
        raise ValueError(f"choose of {', '.join(METHODS.names())}")
    pairs = _pairs(options)
    _check(METHODS.get(name).constants(), pairs, name)
    return Deed(method=name, changes=pairs)


def _study(text: str) -> Deed:
    """`@study NAME [name=value …]`: start a study of the lab, unless it runs."""
    name, *options = text.split() or [""]
    if name not in STUDIES.names():
        raise ValueError(f"choose of {', '.join(STUDIES.names())}")
    pairs = _pairs(options)
    _check(STUDIES.get(name)(), pairs, name)

    def start(state: AppState) -> list[Action]:
        study = state.snapshot.study
        if study is not None and (study.state == "running" or (study.name == name and study.state == "done")):
            return []  # the reader's own is not disturbed
        return [StartStudy(name, dict(pairs), _study_folder(name))]

    return Deed(start, ready=lambda state: own_study(state) in ("", name), study=name)


def own_study(state: AppState) -> str:
    """Return the name of the study that runs because a tour began it; empty: none does."""
    study = state.snapshot.study
    return study.name if study is not None and study.state == "running" and study.folder.parent == _home() else ""


def _home() -> Path:
    return platformdirs.user_cache_path("nerf-viewer") / "tour"


def _study_folder(name: str) -> Path:
    """A fresh folder in the user's cache. Those of long ago go."""
    folder = _home()
    with suppress(OSError):
        for old in folder.iterdir():
            if time.time() - old.stat().st_mtime > KEPT_SECONDS:
                shutil.rmtree(old, ignore_errors=True)
    return folder / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def _do(text: str) -> Deed:
    """`@do COMMAND`: a command of the window by its id; none that writes files, ends the window or turns pages."""
    harmless = [one.id for one in commands() if one.section not in UNFIT]
    if text not in harmless:
        raise ValueError(f"choose of {', '.join(harmless)}")
    return Deed(lambda state: run(text, state))


# By their words after @; docs/tours.md lists them.
DEEDS: dict[str, Callable[[str], Deed]] = {
    "scene": _scene, "method": _method, "train": _train, "pause": _pause,
    "photo": _photo, "orbit": _orbit, "mode": _mode, "cameras": _switch("show_cameras"),
    "samples": _switch("show_samples"), "open": _open, "panel": _panel, "page": _page, "study": _study, "do": _do,
}  # fmt: skip
