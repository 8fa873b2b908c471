"""What the hands mean: pointer over the viewport, and keys. Moves the camera, gathers actions."""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from imgui_bundle import imgui

from nerf_core.live.messages import Inspect, Pause, SaveCheckpoint, StopInspecting, Train
from nerf_core.rendering.modes import mode_names
from nerf_core.training.checkpoint import SUFFIX

from ..draw.viewport import same_view
from ..model.state import Action, AppState, FocusOn, FrameScene, GoToView, PinRay, ResetView, StartOrbitExport
from ..ui.theme import TEXT_PIXELS

CLICK_PIXELS = 4.0  # a press and release further apart, on a screen of scale 1, is a drag
LEFT, RIGHT, MIDDLE = 0, 1, 2


@dataclass
class _Press:
    button: int
    x: float
    y: float
    last: tuple[float, float]
    dragging: bool = False
    focused: bool = False  # the second press of a double click has already done its work


class ViewportInput:
    """Feed it once a frame; take `actions` afterwards."""

    def __init__(self) -> None:
        self.actions: list[Action] = []
        self._press: _Press | None = None
        self._chord = False  # whether Ctrl was down in the last frame

    def take(self) -> list[Action]:
        actions, self.actions = self.actions, []
        return actions

    def pointer(self, state: AppState, origin: tuple[float, float], active: bool, hovered: bool, em: float) -> None:
        """The viewport's widget in this frame. origin: its top left pixel on the screen."""
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
            asked = state.inspect  # of the double click's first press, if that was one and has not moved since
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
            self.actions.append(PinRay(ray))
        return ray

    # ---- keys -------------------------------------------------------------------------------------------------

    def keys(self, state: AppState, seconds: float) -> bool:
        """Act on what is pressed; whether a key is held that moves the camera. A text field has its keys alone."""
        io = imgui.get_io()
        if io.want_text_input:
            return False
        # imgui would step through the fields of the last window with Tab; here it hides the panels.
        imgui.internal.set_key_owner(imgui.Key.tab, imgui.get_id("tab hides the panels"))
        # in a slow frame Ctrl may be up again when its letter has only just come down
        before, self._chord = self._chord, io.key_ctrl or io.key_super
        if self._chord or before:
            self._chords(state)
            return False
        self._single(state)
        return self._fly(state, seconds)

    def _chords(self, state: AppState) -> None:
        if _pressed(imgui.Key.o):
            show_open(state)
        if _pressed(imgui.Key.s) and state.snapshot.scene is not None:
            self.actions.append(save_action(state))
        if _pressed(imgui.Key.e) and state.snapshot.scene is not None:
            self.actions.append(export_action(state))

    def _single(self, state: AppState) -> None:
        if imgui.is_key_pressed(imgui.Key.tab, False):
            state.show_panels = not state.show_panels
        if _pressed(imgui.Key.h):
            state.show_help = not state.show_help
        if _pressed(imgui.Key.escape) and not _close_menus():
            if not state.show_help and state.inspect is not None:
                self.actions.append(StopInspecting())
            state.show_help = False
        _choose_mode(state)
        scene = state.snapshot.scene
        if scene is None:
            return
        if _pressed(imgui.Key.space):
            self.actions.append(Pause() if state.snapshot.status == "training" else Train())
        if _pressed(imgui.Key.period):
            self.actions.append(Train(1))
        if _pressed(imgui.Key.f):
            self.actions.append(FrameScene())
        if _pressed(imgui.Key.r):
            self.actions.append(ResetView())
        for key, step in ((imgui.Key.right_arrow, 1), (imgui.Key.left_arrow, -1)):
            if imgui.is_key_pressed(key, True) and scene.split("train"):
                self.actions.append(GoToView(next_view(scene.split("train"), state.current_view, step)))

    @staticmethod
    def _fly(state: AppState, seconds: float) -> bool:
        if state.snapshot.scene is None:
            return False

        def held(plus: imgui.Key, minus: imgui.Key) -> float:
            return float(imgui.is_key_down(plus)) - float(imgui.is_key_down(minus))

        keys = imgui.Key
        right, up, forward = held(keys.d, keys.a), held(keys.e, keys.q), held(keys.w, keys.s)
        if not (right or up or forward):
            return False
        state.camera.fly(right, up, forward, seconds, imgui.get_io().key_shift)
        state.current_view = None
        return True


def _choose_mode(state: AppState) -> None:
    """1 … 8: what the picture shows of each pixel."""
    keys = (
        imgui.Key._1,
        imgui.Key._2,
        imgui.Key._3,
        imgui.Key._4,
        imgui.Key._5,
        imgui.Key._6,
        imgui.Key._7,
        imgui.Key._8,
    )
    for key, name in zip(keys, mode_names(), strict=False):
        if _pressed(key):
            state.mode = name


def next_view(train: tuple[int, ...], current: int | None, step: int) -> int:
    """The training photo after (or before) the current one, around the end; without one, the first (or last)."""
    if current not in train:
        return train[0 if step > 0 else -1]
    return train[(train.index(current) + step) % len(train)]


def point_under(state: AppState, x: int, y: int) -> np.ndarray | None:
    """The world point (3,) in pixel (x, y) of the viewport: from the picture's depth, else from the inspected ray."""
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
    if ray is None or asked is None or not ray.pixel == asked.pixel == (x, y) or ray.depth_median is None:
        return None
    return ray.origin + ray.depth_median * ray.direction if same_view(asked.camera, camera) else None


def show_open(state: AppState) -> None:
    """Bring up the field for the path of a capture."""
    state.show_panels = state.focus_open = True
    state.raise_panel = "Scene"


def export_action(state: AppState) -> StartOrbitExport:
    """Export as the form says, and show its panel: there one sees how long it takes, and can cancel it."""
    state.show_panels, state.raise_panel = True, "Export"
    return StartOrbitExport()


def save_action(state: AppState) -> SaveCheckpoint:
    """Save where the user said; else in a file of the scene's name that is not there yet, which is then shown."""
    if not state.checkpoint_file.strip() and state.snapshot.scene is not None:
        name = re.sub(r"[^\w.-]+", "-", state.snapshot.scene.name).strip(".-")[:80] or "checkpoint"
        numbered = (f"{name}{f'-{n}' if n > 1 else ''}{SUFFIX}" for n in itertools.count(1))
        state.checkpoint_file = next(file for file in numbered if not os.path.lexists(file))
    return SaveCheckpoint(Path(state.checkpoint_file.strip()))


def _close_menus() -> bool:
    """Close what is open of menus and lists; whether anything was."""
    anything = imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level
    if not imgui.is_popup_open("", anything):
        return False
    imgui.internal.close_popup_to_level(0, True)
    return True


def _apart(pixel: tuple[int, int], place: tuple[float, float]) -> float:
    return max(abs(pixel[0] + 0.5 - place[0]), abs(pixel[1] + 0.5 - place[1]))


def _reach(em: float) -> float:
    return CLICK_PIXELS * em / TEXT_PIXELS


def _pressed(key: imgui.Key) -> bool:
    return imgui.is_key_pressed(key, False)
