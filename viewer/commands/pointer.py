"""Pointer input over the viewport: drags move the camera, clicks open rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from imgui_bundle import imgui

from nerf_core.common.language import marked
from nerf_core.live.messages import Inspect, PinRay

from ..draw.warp import same_view
from ..model.state import Action, AppState, FocusOn
from ..ui.theme import TEXT_PIXELS
from .registry import Section

CLICK_PIXELS = 4.0  # a larger distance between press and release, on a screen of scale 1, is a drag
LEFT, RIGHT, MIDDLE = 0, 1, 2


class Gesture(NamedTuple):
    """A line of the help for a gesture that is not a command. section: the heading it shares with commands."""

    section: Section
    title: str
    how: str


GESTURES = (
    Gesture("Camera", marked("Orbit"), marked("drag")),
    Gesture("Camera", marked("Pan"), marked("right drag, Shift+drag")),
    Gesture("Camera", marked("Zoom"), marked("wheel, towards the pointer")),
    Gesture("Camera", marked("Focus on a point"), marked("double click")),
    Gesture("Camera", marked("Fly"), "W A S D"),
    Gesture("Camera", marked("Fly down, up"), "Q, E"),
    Gesture("Camera", marked("Fly faster"), "Shift"),
    Gesture("Ray", marked("Open a ray"), marked("click")),
    Gesture("Ray", marked("Pin a ray"), marked("Ctrl+click")),
    Gesture("Ray", marked("Move the radiance point"), marked("drag its line in the ray panel")),
    Gesture("Plots", marked("Fit"), marked("double click")),
    Gesture("Plots", marked("Move, zoom"), marked("drag, wheel")),
)


@dataclass
class _Press:
    button: int
    x: float
    y: float
    last: tuple[float, float]
    dragging: bool = False
    focused: bool = False  # the second press of a double click has already focused


class ViewportInput:
    """Call `pointer` once per frame, then `take` the actions."""

    def __init__(self) -> None:
        self.actions: list[Action] = []
        self._press: _Press | None = None

    def take(self) -> list[Action]:
        actions, self.actions = self.actions, []
        return actions

    def pointer(self, state: AppState, origin: tuple[float, float], active: bool, hovered: bool, em: float) -> None:
        """Process the pointer in this frame. origin: the viewport's top left pixel on the screen."""
        io = imgui.get_io()
        x, y = io.mouse_pos.x - origin[0], io.mouse_pos.y - origin[1]
        width, height = state.viewport
        if hovered and io.mouse_wheel != 0 and state.snapshot.scene is not None:
            state.camera.zoom(io.mouse_wheel, x, y, width, height)
            state.current_view = None
        if active and self._press is None:
            self._begin(state, x, y, em)
        press = self._press
        if press is None:
            return
        if active:
            self._follow(state, press, x, y, em)
            return
        self._press = None
        near = max(abs(x - press.x), abs(y - press.y)) <= _reach(em)
        if press.button == LEFT and near and not (press.dragging or press.focused):
            self._inspect(state, int(np.floor(press.x)), int(np.floor(press.y)))

    def _begin(self, state: AppState, x: float, y: float, em: float) -> None:
        button = next((b for b in (LEFT, RIGHT, MIDDLE) if imgui.is_mouse_down(b)), None)
        if button is None:
            return
        self._press = _Press(button, x, y, (x, y))
        if button == LEFT and imgui.is_mouse_double_clicked(LEFT):
            self._press.focused = True
            column, row = int(np.floor(x)), int(np.floor(y))
            point = point_under(state, column, row)
            if point is not None:
                self.actions.append(FocusOn(point))
            asked = state.inspect  # by the double click's first press, if the pointer has not moved since
            camera = state.camera.camera(*state.viewport)
            if asked is None or not same_view(asked.camera, camera) or _apart(asked.pixel, (x, y)) > _reach(em):
                asked = self._inspect(state, column, row)
            state.focus = asked

    def _follow(self, state: AppState, press: _Press, x: float, y: float, em: float) -> None:
        press.dragging |= max(abs(x - press.x), abs(y - press.y)) > _reach(em)
        if not press.dragging or (x, y) == press.last or state.snapshot.scene is None:
            return
        dx, dy = x - press.last[0], y - press.last[1]
        press.last = (x, y)
        height = state.viewport[1]
        if press.button == LEFT and not imgui.get_io().key_shift:
            state.camera.orbit(dx, dy, height)
        else:
            state.camera.pan(dx, dy, height)
        state.current_view = None

    def _inspect(self, state: AppState, x: int, y: int) -> Inspect | None:
        """Open the ray of a pixel; None outside the picture."""
        width, height = state.viewport
        if state.snapshot.scene is None or not (0 <= x < width and 0 <= y < height):
            return None
        ray = Inspect(state.camera.camera(width, height), (x, y))
        self.actions.append(ray)
        if imgui.get_io().key_ctrl:
            self.actions.append(PinRay.of(ray))
        return ray


def point_under(state: AppState, x: int, y: int) -> np.ndarray | None:
    """Return the world point (3,) at pixel (x, y) of the viewport, from the picture's depth or the opened ray."""
    camera = state.camera.camera(*state.viewport)
    preview = state.snapshot.preview
    if preview is not None and same_view(preview.camera, camera):
        height, width = preview.depth.shape
        row, column = min(round(y / preview.stride), height - 1), min(round(x / preview.stride), width - 1)
        z = float(preview.depth[row, column])
        local = np.array([(x + 0.5 - camera.cx) / camera.fx, -(y + 0.5 - camera.cy) / camera.fy, -1.0]) * z
        if np.isfinite(z):
            return camera.c2w[:, :3] @ local + camera.c2w[:, 3]
    ray, asked = state.snapshot.ray, state.inspect
    if ray is None or asked is None or ray.depth_median is None:
        return None
    if state.snapshot.opened_id != asked.id or asked.pixel != (x, y):
        return None
    return ray.origin + ray.depth_median * ray.direction if same_view(asked.camera, camera) else None


def _apart(pixel: tuple[int, int], place: tuple[float, float]) -> float:
    return max(abs(pixel[0] + 0.5 - place[0]), abs(pixel[1] + 0.5 - place[1]))


def _reach(em: float) -> float:
    return CLICK_PIXELS * em / TEXT_PIXELS
