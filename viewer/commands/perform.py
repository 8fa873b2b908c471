"""Carry out the actions of panels, keys and menus."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerf_core.common.errors import UserError
from nerf_core.common.names import printable
from nerf_core.common.user_paths import absolute, own_path
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import (
    Command,
    ExportRays,
    InOrder,
    Inspect,
    LoadCheckpoint,
    Notice,
    OpenScene,
    SaveCheckpoint,
    StartExport,
    StopInspecting,
    UseMethod,
    WriteReport,
)
from nerf_core.rendering.export.requests import ExportModel, ExportPath

from ..model.link import Link
from ..model.state import (
    Action,
    AppState,
    ClearAutosaves,
    FilmForm,
    FocusOn,
    FrameScene,
    GoToView,
    ResetView,
    SaveScreenshot,
    SetDisc,
    SetPointDepth,
    ShownNotice,
    StartFilmExport,
)


class Actions:
    def __init__(self, state: AppState, link: Link) -> None:
        self._state = state
        self._link = link
        self.screenshots: list[Path] = []  # written when the frame is complete
        # the commands whose success changes the settings, or whose failure leaves nothing open, by number
        self._asked: dict[int, OpenScene | UseMethod] = {}

    def perform(self, action: Action) -> int:
        """Carry out an action. Returns the number of the command sent to the worker, else 0. Errors become notices."""
        try:
            return self._perform(action)
        except UserError as error:
            self.tell(Notice("error", str(error)))
            return 0

    def hear(self, notice: Notice) -> None:
        """Take a notice of the worker, and show it."""
        asked = self._asked.pop(notice.command, None) if notice.kind in ("loaded", "failed") else None
        if notice.kind == "loaded" and not (asked is None or (isinstance(asked, OpenScene) and not asked.checkpoint)):
            self._take_over(asked)
        self.tell(notice)
        if notice.kind == "failed" and isinstance(asked, OpenScene) and self._state.snapshot.scene is None:
            self._state.not_opened, self._state.show_left_off = notice.text, False
            self._state.notices[-1].dismissed = True  # the viewport says it

    def _take_over(self, done: OpenScene | UseMethod) -> None:
        """Open what is opened next like this one."""
        state = self._state
        if isinstance(done, UseMethod):
            state.settings = replace(state.settings, method=done.name, preset="auto", changes=dict(done.changes))
        else:
            load = replace(done.options.load, format="auto")  # the format is this capture's alone
            state.settings = replace(state.settings, load=load)
            state.open_path = "" if done.path is None else printable(done.path)

    def tell(self, notice: Notice) -> None:
        self._state.notices.append(ShownNotice(notice, self._state.time))

    def _perform(self, action: Action) -> int:
        state, scene = self._state, self._state.snapshot.scene
        match action:
            case GoToView() | FocusOn() | ResetView() | FrameScene():
                self._move(action)
            case SetPointDepth(t):
                return 0 if state.inspect is None else self._perform(state.inspect.again(point_t=t))
            case SetDisc(around):
                return 0 if state.inspect is None else self._perform(state.inspect.again(around=around))
            case SaveScreenshot(path):
                self.screenshots.append(absolute(path))  # the notice says in which folder it is
            case ClearAutosaves():
                state.left_off.clear()
            case StartFilmExport(file):
                if scene is None:
                    raise UserError("there is no scene to film: open one first")
                return self._link.send(StartExport(film_export(scene, state.film, file)))
            case _:
                return self._send(action)
        return 0

    def _send(self, command: Command) -> int:
        if isinstance(command, InOrder):
            command = replace(command, commands=tuple(self._prepared(one) for one in command.commands))
        command = self._prepared(command)
        number = self._link.send(command)
        for one in command.commands if isinstance(command, InOrder) else (command,):
            if isinstance(one, UseMethod | OpenScene):
                self._asked[number] = one
        return number

    def _prepared(self, command: Any) -> Any:
        """Note what a command changes in the state; return it with the paths that a user may write."""
        state = self._state
        match command:
            case Inspect():
                state.inspect = command
            case StopInspecting():
                state.inspect = None
            case OpenScene(path):
                state.inspect = None
                command = command if path is None else replace(command, path=own_path(path))
            case SaveCheckpoint(path) | LoadCheckpoint(path):
                command = replace(command, path=own_path(path))
            case ExportRays(file) | WriteReport(file):
                command = replace(command, file=own_path(file))
            case StartExport(ExportModel(file)):
                command = replace(command, request=ExportModel(own_path(file)))
            case _:
                pass
        return command

    def _move(self, action: GoToView | FocusOn | ResetView | FrameScene) -> None:
        state, scene = self._state, self._state.snapshot.scene
        state.current_view = None
        match action:
            case GoToView(index):
                if scene is not None and 0 <= index < len(scene.views):  # another scene may have been opened since
                    state.camera.go_to(scene.views[index].camera)
                    state.current_view = index
            case FocusOn(point):
                state.camera.focus(point)
            case ResetView():
                state.camera.reset()
            case FrameScene():
                state.camera.frame()


def film_export(scene: Scene, form: FilmForm, file: Path | None = None) -> ExportPath:
    """Return the command that the export form describes. Raises UserError for values that give no film.

    file: where to; None: where the form says.
    """
    if not (math.isfinite(form.fps) and form.fps > 0):
        raise UserError(f"a film of {form.fps:g} frames per second: the number must be greater than 0")
    file = file or Path(form.file.strip())
    if not file.name:
        raise UserError("the film has no file name: give one that ends in .mp4")
    numbers = (form.frames or None, form.width or None, form.height or None)
    file = own_path(file)
    cameras: tuple[Camera, ...] = PATHS.get(form.path).cameras(scene, *numbers, **form.options)
    return ExportPath(cameras, form.fps, file if file.suffix else file.with_suffix(".mp4"), form.png_frames)
