"""The colour that one point emits in every direction: a disc of what faces the viewer, and a map of the sphere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.cameras import distort
from nerf_core.probe import DISC_SIZE, SPHERE_COLUMNS, SPHERE_ROWS, RadianceProbe, disc_grid
from nerf_core.scene import Scene
from viewer.panels import PANELS, Ui
from viewer.state import Action, AppState, SetPointDepth
from viewer.widgets import Row, button, figures, hint, mono, number, packed, swatch, triple, vector

CAPTIONS = ("facing the viewer", "all directions, up at the top")


@dataclass(frozen=True)
class Pictures:
    """What one probe looks like; made once, so that it is uploaded once."""

    probe: RadianceProbe
    disc: np.ndarray
    sphere: np.ndarray

    @staticmethod
    def of(probe: RadianceProbe) -> Pictures:
        disc = probe.disc_image()[_nearest_inside()]
        disc[..., 3] = 1
        sphere = np.concatenate([probe.sphere_image(), np.ones((SPHERE_ROWS, SPHERE_COLUMNS, 1), np.float32)], -1)
        return Pictures(probe, _bytes(disc), _bytes(sphere))


@dataclass(frozen=True)
class TrainingViews:
    """Directions (C, 3) from the point to the training cameras, and which of them (C,) have it in their frame."""

    directions: np.ndarray
    framed: np.ndarray


class TrainingCameras:
    """A capture's training cameras side by side: there may be thousands, and a point asks all of them at once."""

    def __init__(self, scene: Scene | None) -> None:
        self.scene = scene
        cameras = [scene.views[i].camera for i in scene.split("train")] if scene is not None else []
        self._c2w = np.array([c.c2w for c in cameras], np.float64).reshape(-1, 3, 4)
        self._intrinsics = np.array([c.intrinsics() for c in cameras], np.float64).reshape(-1, 11)

    def look_at(self, point: np.ndarray) -> TrainingViews:
        offsets = point - self._c2w[:, :, 3]
        local = np.einsum("cij,ci->cj", self._c2w[:, :, :3], offsets)
        depth = -local[:, 2]
        plane = np.stack([local[:, 0], -local[:, 1]], -1) / np.maximum(depth, 1e-12)[:, None]  # behind: not framed
        width, height, fx, fy, cx, cy, *lens = self._intrinsics.T
        x, y = distort(plane, *lens).T
        x, y = x * fx + cx, y * fy + cy
        framed = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return TrainingViews(_unit(-offsets), framed)


@PANELS.register("radiance")
class RadiancePanel:
    title = "Radiance"
    dock: Literal["bottom_right"] = "bottom_right"
    order = 0

    def __init__(self) -> None:
        self.hovered: tuple[np.ndarray, np.ndarray] | None = None  # direction and colour under the mouse
        self._pictures: Pictures | None = None
        self._cameras = TrainingCameras(None)
        self._views = self._cameras.look_at(np.zeros(3))

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        probe = state.snapshot.radiance
        if probe is None:
            hint(ui, _nothing_yet(state))
            return
        if self._pictures is None or self._pictures.probe is not probe:
            self._pictures = Pictures.of(probe)
            if self._cameras.scene is not state.snapshot.scene:
                self._cameras = TrainingCameras(state.snapshot.scene)
            self._views = self._cameras.look_at(probe.point)
        yield from self._draw(ui, state, self._pictures, self._views)
        if self.hovered is not None:
            _tooltip(ui, *self.hovered)

    def _draw(self, ui: Ui, state: AppState, pictures: Pictures, views: TrainingViews) -> Iterator[Action]:
        """The disc, and the map with the figures beside it where there is room, else below."""
        viewer = _unit(state.camera.c2w()[:, 3] - pictures.probe.point)
        avail, gap, line = imgui.get_content_region_avail(), ui.em, imgui.get_text_line_height_with_spacing()
        side = max(min(avail.y - line, (avail.x - gap) * 0.36), 5 * ui.em)
        beside = side + gap + 9 * ui.em <= avail.x
        imgui.begin_group()
        self.hovered = _disc(ui, pictures, views, viewer, min(side, avail.x))
        imgui.push_text_wrap_pos(imgui.get_cursor_pos_x() + side)
        imgui.text_colored(ui.theme.muted, CAPTIONS[0])
        imgui.pop_text_wrap_pos()
        imgui.end_group()
        if beside:
            imgui.same_line(0, gap)
        imgui.begin_group()
        width = min(imgui.get_content_region_avail().x, 2 * max(avail.y - 5 * line, 4 * ui.em))
        self.hovered = _sphere(ui, pictures, views, viewer, width) or self.hovered
        hint(ui, CAPTIONS[1])
        yield from _point(ui, state, pictures.probe)
        if state.snapshot.ray is not None and state.snapshot.ray.depth_strongest is None:
            hint(ui, "The ray met nothing: this point is empty, and its colour is never seen.", ui.theme.warning)
        _sight(ui, views)
        imgui.end_group()


def _point(ui: Ui, state: AppState, probe: RadianceProbe) -> Iterator[Action]:
    """Where the point lies, and the way back to the median depth once it was moved."""
    imgui.align_text_to_frame_padding()
    imgui.text_colored(ui.theme.muted, "t")
    imgui.same_line()
    with mono(ui):
        imgui.text_unformatted(number(probe.t, 5))
    moved = state.inspect is not None and state.inspect.point_t is not None
    imgui.same_line()
    tip = "Back to the median depth. Drag the line in the ray panel to choose another depth."
    if button(ui, "median depth", "radiance.median", enabled=moved, tip=tip):
        yield SetPointDepth(None)
    figures(ui, "point", [("x", vector(probe.point))])


def _disc(
    ui: Ui, pictures: Pictures, views: TrainingViews, viewer: np.ndarray, side: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """A hover answers with the direction and the colour under the mouse."""
    probe, low, radius = pictures.probe, imgui.get_cursor_screen_pos(), side / 2
    high, centre = ImVec2(low.x + side, low.y + side), ImVec2(low.x + radius, low.y + radius)
    draw, white = imgui.get_window_draw_list(), packed(ImVec4(1, 1, 1, 1))
    texture = ui.texture("radiance disc", pictures.disc)
    draw.add_image_rounded(texture, low, high, ImVec2(0, 0), ImVec2(1, 1), white, radius)
    draw.add_circle(centre, radius, packed(ui.theme.hairline))
    imgui.invisible_button("disc", ImVec2(side, side))
    ui.mark("radiance.disc")
    hovered = imgui.is_item_hovered()

    def place(direction: np.ndarray) -> ImVec2 | None:
        at = probe.disc_position(direction)
        return None if at is None else ImVec2(centre.x + at[0] * radius, centre.y - at[1] * radius)

    _marks(ui, place, views, viewer)
    mouse = imgui.get_mouse_pos()
    x, y = (mouse.x - centre.x) / radius, (centre.y - mouse.y) / radius
    if not hovered or x * x + y * y >= 1:
        return None
    direction = np.array([x, y, np.sqrt(1 - x * x - y * y)]) @ probe.axes
    row, column = (min(int((v + 1) / 2 * DISC_SIZE), DISC_SIZE - 1) for v in (-y, x))
    return direction, pictures.disc[row, column, :3] / 255


def _sphere(
    ui: Ui, pictures: Pictures, views: TrainingViews, viewer: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray] | None:
    probe, low, height = pictures.probe, imgui.get_cursor_screen_pos(), width / 2
    imgui.image(ui.texture("radiance sphere", pictures.sphere), ImVec2(width, height))
    ui.mark("radiance.sphere")
    hovered, draw = imgui.is_item_hovered(), imgui.get_window_draw_list()
    draw.add_rect(low, ImVec2(low.x + width, low.y + height), packed(ui.theme.hairline))

    def place(direction: np.ndarray) -> ImVec2:
        column, row = probe.sphere_position(direction)
        return ImVec2(low.x + column * width, low.y + row * height)

    _marks(ui, place, views, viewer)
    if not hovered:
        return None
    mouse = imgui.get_mouse_pos()
    column, row = (float(np.clip(v, 0, 1 - 1e-9)) for v in ((mouse.x - low.x) / width, (mouse.y - low.y) / height))
    azimuth, polar = 2 * np.pi * column, np.pi * row
    side = np.cross(probe.up, probe.azimuth0)
    around = np.cos(azimuth) * probe.azimuth0 + np.sin(azimuth) * side
    rgb = pictures.sphere[int(row * SPHERE_ROWS), int(column * SPHERE_COLUMNS), :3] / 255
    return np.cos(polar) * probe.up + np.sin(polar) * around, rgb


def _marks(ui: Ui, place: Callable[[np.ndarray], ImVec2 | None], views: TrainingViews, viewer: np.ndarray) -> None:
    """Training cameras as dots, hollow where the point is out of their frame; the current view as crosshairs."""
    draw, r = imgui.get_window_draw_list(), 0.14 * ui.em
    light, dark = packed(ImVec4(1, 1, 1, 0.9)), packed(ImVec4(0, 0, 0, 0.9))  # one of them shows on any colour
    for direction, framed in zip(views.directions, views.framed, strict=True):
        at = place(direction)
        if at is not None and framed:
            draw.add_circle_filled(at, 1.6 * r, dark, 8)
            draw.add_circle_filled(at, r, light, 8)
        elif at is not None:
            draw.add_circle(at, r, light, 8)
    at = place(viewer)
    if at is None:
        return
    reach = 0.55 * ui.em
    for color, weight in ((dark, 0.25 * ui.em), (packed(ui.theme.accent), 0.13 * ui.em)):
        draw.add_circle(at, 0.7 * reach, color, thickness=weight)
        draw.add_line(ImVec2(at.x - reach, at.y), ImVec2(at.x + reach, at.y), color, weight)
        draw.add_line(ImVec2(at.x, at.y - reach), ImVec2(at.x, at.y + reach), color, weight)


def _sight(ui: Ui, views: TrainingViews) -> None:
    count, framed = len(views.framed), int(views.framed.sum())
    if count and not framed:
        hint(
            ui,
            f"None of the {count:,} training cameras has this point in its frame: its colour is a guess.",
            ui.theme.warning,
        )
    elif count:
        hint(ui, f"{framed:,} of {count:,} training cameras (dots) have it in their frame")


def _tooltip(ui: Ui, direction: np.ndarray, rgb: np.ndarray) -> None:
    if imgui.begin_tooltip():
        rows: list[Row] = [("v", vector(direction)), ("rgb", f" {triple(rgb)}", partial(swatch, ui, rgb))]
        figures(ui, "direction", rows, 16 * ui.em)
        imgui.end_tooltip()


def _nothing_yet(state: AppState) -> str:
    if state.inspect is not None:
        return "Looking at this point from all around …"
    return "Click a pixel: here you will see the colour that its surface emits in every direction."


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-12)  # a camera in the point itself has no direction: it marks the centre


def _bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


@cache
def _nearest_inside() -> tuple[np.ndarray, np.ndarray]:
    """For every texel of the disc the row and column of one inside, so that smoothing draws no black in at the edge."""
    x, y, _ = disc_grid()
    shrink = np.minimum(1, (1 - 2 / DISC_SIZE) / np.maximum(np.hypot(x, y), 1e-12))  # the centre stays where it is
    rows, columns = (((v * shrink + 1) / 2 * DISC_SIZE).astype(int) for v in (-y, x))
    return rows, columns
