"""The map of Flatland: the learnt field or the world, the ring of cameras, and a ray with its samples and weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.lab.flatland.view import FlatPass, FlatRay, FlatView

from ..ui.widgets import faded, packed, tints
from .opaque import OpaquePictures

if TYPE_CHECKING:
    from ..ui.contract import Ui

MARGIN = 1.1  # the map reaches beyond the ring by this factor, so that cameras fit
BAR = 0.32  # length of the heaviest sample's bar, in world units
REACH_EM = 1.4  # a camera is chosen from this distance
Place = Callable[[np.ndarray], ImVec2]  # from a point of the world to the screen
LEAST_WEIGHT = 0.01  # of the heaviest: a smaller one has no bar


@dataclass(frozen=True)
class Chosen:
    """A ray that the mouse chooses: its camera, and a pixel; None: the camera alone."""

    camera: int
    pixel: int | None


class FlatMap:
    """A square picture of [−1, 1]² within the ring."""

    def __init__(self) -> None:
        self._opaque = OpaquePictures()

    def draw(self, ui: Ui, view: FlatView, side: float, learnt: bool, mark: str, camera: int) -> Chosen | None:
        """Draw it, and return what the mouse chooses.

        Args:
            ui: where to draw.
            view: what is shown.
            side: in pixels.
            learnt: the learnt field with the ray; else the world, with the ray as a line.
            mark: the widget's name.
            camera: the chosen one.
        """
        at = imgui.get_cursor_screen_pos()
        imgui.invisible_button(mark, ImVec2(side, side))
        ui.mark(mark)
        extent = MARGIN * float(np.linalg.norm(view.cameras, axis=1).max())
        scale = side / (2 * extent)

        def place(p: np.ndarray) -> ImVec2:
            return ImVec2(at.x + side / 2 + float(p[0]) * scale, at.y + side / 2 - float(p[1]) * scale)

        draw = imgui.get_window_draw_list()
        draw.push_clip_rect(at, ImVec2(at.x + side, at.y + side), True)
        picture = view.field if learnt else view.truth
        ground = tints(picture[:1, 0] / 255)[0]  # the background goes on outside the square
        draw.add_rect_filled(at, ImVec2(at.x + side, at.y + side), ground)
        texture = ui.texture(f"{mark} picture", self._opaque.rgba(mark, picture))
        draw.add_image(texture, place(np.array([-1.0, 1.0])), place(np.array([1.0, -1.0])))
        for k, p in enumerate(view.cameras):
            self._camera(ui, draw, place, p, 0.5 * ui.em / scale, k < view.training, k == camera)
        if view.ray is not None:
            self._ray(ui, draw, place, scale, view.ray, with_samples=learnt)
        draw.pop_clip_rect()
        if not imgui.is_item_hovered():
            return None
        mouse = imgui.get_mouse_pos()
        p = np.array([mouse.x - at.x - side / 2, at.y + side / 2 - mouse.y]) / scale
        return chosen_at(view, p, camera, REACH_EM * ui.em / scale)

    def _camera(
        self, ui: Ui, draw: imgui.ImDrawList, place: Place, p: np.ndarray, size: float, training: bool, chosen: bool
    ) -> None:
        inwards = -p / np.linalg.norm(p)
        across = np.array([-inwards[1], inwards[0]])
        tip, left = place(p + 0.9 * size * inwards), place(p + size * (0.6 * across - 0.5 * inwards))
        right = place(p - size * (0.6 * across + 0.5 * inwards))
        color = packed(ui.theme.ray if chosen else ui.theme.text if training else ui.theme.muted)
        if training:
            draw.add_triangle_filled(tip, left, right, color)
        else:
            draw.add_triangle(tip, left, right, color, max(1.0, 0.08 * ui.em))

    def _ray(
        self, ui: Ui, draw: imgui.ImDrawList, place: Place, scale: float, ray: FlatRay, with_samples: bool
    ) -> None:
        def along(t: float, aside: float = 0.0) -> ImVec2:
            across = np.array([-ray.direction[1], ray.direction[0]])
            return place(ray.origin + t * ray.direction + aside * across)

        draw.add_line(along(0), along(ray.far), packed(faded(ui.theme.ray, 0.7)), max(1.0, 0.07 * ui.em))
        if not with_samples or not ray.passes:
            return
        fine = ray.passes[-1]
        top = max(float(fine.weights.max()), 1e-9)
        color = packed(ui.theme.fine)
        for t, w in zip(fine.t.tolist(), (fine.weights / top).tolist(), strict=True):
            if w > LEAST_WEIGHT:
                draw.add_line(along(t), along(t, BAR * w), color, max(1.5, 0.13 * ui.em))
        between = (ray.far - ray.near) / len(ray.passes[0].t) * scale
        for one in ray.passes:
            self._samples(ui, draw, along, one, float(np.clip(0.42 * between, 1.5, 0.22 * ui.em)))

    def _samples(
        self, ui: Ui, draw: imgui.ImDrawList, along: Callable[[float], ImVec2], one: FlatPass, radius: float
    ) -> None:
        for t in one.t.tolist():
            if one.name == "coarse":
                draw.add_circle(along(t), radius, packed(ui.theme.coarse), thickness=max(1.0, 0.06 * ui.em))
            else:
                draw.add_circle_filled(along(t), max(1.0, 0.5 * radius), packed(ui.theme.fine))


def chosen_at(view: FlatView, p: np.ndarray, camera: int, reach: float) -> Chosen | None:
    """Return what a point chooses: a camera within reach, else the chosen camera's pixel that sees the point.

    Args:
        view: what is shown.
        p: (2,) the point.
        camera: the chosen camera.
        reach: how far from a camera it is still meant.
    """
    away = np.linalg.norm(view.cameras - p, axis=1)
    nearest = int(away.argmin())
    if away[nearest] < reach:
        return Chosen(nearest, None)
    if np.abs(p).max() > 1 or not 0 <= camera < len(view.cameras):
        return None
    return Chosen(camera, pixel_towards(view, camera, p))


def pixel_towards(view: FlatView, camera: int, p: np.ndarray) -> int:
    """Return the pixel of a camera whose ray passes nearest to a point. The photo's edges touch the unit circle."""
    eye, wide = view.cameras[camera].astype(np.float64), view.photos.shape[1]
    away = float(np.linalg.norm(eye))
    inwards = -eye / away
    right = np.array([inwards[1], -inwards[0]])
    offset = np.asarray(p, np.float64) - eye
    slope = float(offset @ right) / max(float(offset @ inwards), 1e-6)
    edge = 1 / np.sqrt(away**2 - 1)
    return int(np.clip((slope / edge + 1) / 2 * wide, 0, wide - 1))
