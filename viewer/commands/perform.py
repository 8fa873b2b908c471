"""Does what panels, keys and menus ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerf_core.common.errors import UserError
from nerf_core.common.user_paths import own_path
from nerf_core.datasets.formats.demo import LANDMARKS
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths.orbit import Orbit
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import (
    ExportPath,
    ExportRays,
    Inspect,
    LoadCheckpoint,
    Notice,
    OpenScene,
    Pin,
    SaveCheckpoint,
    StopInspecting,
    Unpin,
)

from ..model import pins
from ..model.link import Link
from ..model.state import (
    Action,
    AppState,
    FocusOn,
    FrameScene,
    GoToView,
    OpenPin,
    OrbitForm,
    PinRay,
    ResetView,
    SaveScreenshot,
    SetDisc,
    SetPointDepth,
    ShownNotice,
    StartOrbitExport,
    UnpinRay,
)


class Actions:
    def __init__(self, state: AppState, link: Link) -> None:
        self._state = state
        self._link = link
        self.screenshots: list[Path] = []  # to be written when the frame is complete

    def perform(self, action: Action) -> None:
        """Do it now. What cannot be done becomes an error notice."""
        try:
            self._perform(action)
        except UserError as error:
            self.tell(Notice("error", str(error)))

    def tell(self, notice: Notice) -> None:
        self._state.notices.append(ShownNotice(notice, self._state.time))

    def _perform(self, action: Action) -> None:  # noqa: PLR0912  one branch an action
        state, scene = self._state, self._state.snapshot.scene
        match action:
            case GoToView() | FocusOn() | ResetView() | FrameScene():
                self._move(action)
            case SetPointDepth(t):
                if state.inspect is not None:
                    self._perform(replace(state.inspect, point_t=t))
            case PinRay() | OpenPin() | UnpinRay():
                self._pin(action)
            case SetDisc(around):
                if state.inspect is not None:
                    self._perform(replace(state.inspect, around=around))
            case SaveScreenshot(path):
                self.screenshots.append(path)
            case StartOrbitExport():
                if scene is None:
                    raise UserError("there is no scene to make an orbit of: open one first")
                self._link.send(orbit_export(scene, state.orbit))
            case Inspect():
                state.inspect = action
                self._link.send(action)
            case OpenScene(path):
                state.inspect = None
                self._link.send(action if path is None else replace(action, path=own_path(path)))
            case SaveCheckpoint(path):
                self._link.send(SaveCheckpoint(own_path(path), pins.to_json(state.pins)))
            case ExportRays(path, names):
                self._link.send(ExportRays(own_path(path), names))
            case LoadCheckpoint(path):
                self._link.send(replace(action, path=own_path(path)))
            case StopInspecting():
                state.inspect = None
                self._link.send(action)
            case _:
                self._link.send(action)

    def _pin(self, action: PinRay | OpenPin | UnpinRay) -> None:
        state = self._state
        match action:
            case PinRay(ray):
                if len(state.pins) >= pins.MOST:
                    for landmark in pins.spare(state.pins)[:1]:
                        self._pin(UnpinRay(landmark.id))
                pin = pins.new_pin(state.pins, ray)
                state.pins.append(pin)
                self._link.send(Pin(pin.id, ray.camera, ray.pixel))
            case OpenPin(number):
                for pin in state.pins:
                    if pin.id == number:
                        self._perform(pin.ray)
            case UnpinRay(number):
                state.pins = [pin for pin in state.pins if pin.id != number]
                self._link.send(Unpin(number))

    def pin_landmarks(self, scene: Scene) -> None:
        """Of the demo scene: out of sight, so that their histories begin with training."""
        if scene.format != "demo" or not scene.split("train"):
            return
        camera = scene.views[scene.split("train")[0]].camera
        for name, x, y in LANDMARKS:
            pixel = int(x * camera.width), int(y * camera.height)
            pin = replace(pins.new_pin(self._state.pins, Inspect(camera, pixel)), name=name, hidden=True)
            self._state.pins.append(pin)
            self._link.send(Pin(pin.id, camera, pixel))

    def restore(self, session: Mapping[str, Any]) -> None:
        """Pin what a loaded checkpoint brought back; where it brings nothing, what is pinned stays."""
        try:
            stored = pins.from_json(session)
        except UserError as error:
            self.tell(Notice("warning", str(error)))
            return
        if not stored:
            return
        for pin in self._state.pins:
            self._link.send(Unpin(pin.id))
        self._state.pins = stored
        for pin in stored:
            self._link.send(Pin(pin.id, pin.ray.camera, pin.ray.pixel))

    def _move(self, action: GoToView | FocusOn | ResetView | FrameScene) -> None:
        state, scene = self._state, self._state.snapshot.scene
        state.current_view = None
        match action:
            case GoToView(index):
                if scene is not None and 0 <= index < len(scene.views):  # else another scene was opened since
                    state.camera.go_to(scene.views[index].camera)
                    state.current_view = index
            case FocusOn(point):
                state.camera.focus(point)
            case ResetView():
                state.camera.reset()
            case FrameScene():
                state.camera.frame()


def orbit_export(scene: Scene, form: OrbitForm) -> ExportPath:
    """The command that the export form describes. Raises UserError for values that give no film."""
    if not (math.isfinite(form.fps) and form.fps > 0):
        raise UserError(f"an orbit of {form.fps:g} frames a second is none: take a positive number")
    file = own_path(Path(form.file.strip()))
    if not file.name:
        raise UserError("the orbit has no file name: give one that ends in .mp4")
    cameras: tuple[Camera, ...] = Orbit.cameras(
        scene,
        form.frames,
        form.width or None,
        form.height or None,
        elevation=form.elevation_degrees,
        radius=form.radius or None,
    )
    return ExportPath(cameras, form.fps, file if file.suffix else file.with_suffix(".mp4"), form.png_frames)
