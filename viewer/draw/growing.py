"""A sparse model while it grows: its points and cameras, seen over the cameras' shoulders, from side to side."""

from __future__ import annotations

import math

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.captures.records import Growing
from nerf_core.geometry.camera import Camera

from ..ui.contract import Ui
from ..ui.widgets import faded
from .overlays import Overlay, frusta

SWING, SWING_SECONDS = math.radians(40.0), 16.0  # how far the view swings to either side, and how long there and back
ELEVATION = math.radians(28.0)
FIELD_OF_VIEW = math.radians(50.0)
AWAY = 1.6  # of what encloses most cameras: they then fill the picture
FRUSTUM = 0.09  # depth of a camera's pyramid, in the same unit
SPLAT = 2  # pixels of a point's side
DIM = 50  # the least grey of a point: dark ones would not show on the dark ground


class GrowingModel:
    """Its picture is made anew for each model and each moment of the swing."""

    def draw(self, ui: Ui, draw: imgui.ImDrawList, origin: ImVec2, size: tuple[int, int], model: Growing, time: float) -> None:  # fmt: skip  # noqa: E501
        """Draw into a rectangle of the screen. time: in seconds, swings the view."""
        center, radius, up = frame(model)
        camera = _camera(center, radius, up, _behind(model, center), time, size)
        far = ImVec2(origin.x + size[0], origin.y + size[1])
        draw.add_image(ui.texture("growing", splats(model, camera), smooth=False), origin, far)
        overlay = Overlay(draw, camera, (origin.x, origin.y), 0.01 * radius)
        cameras = [Camera(4, 3, 4.0, 4.0, 2.0, 1.5, pose.astype(np.float64)) for pose in model.poses]
        if cameras:
            shade = ImVec4(0, 0, 0, 0.5), ui.em / 6
            overlay.lines(
                *frusta(cameras, FRUSTUM * radius), shade, (faded(ui.theme.accent, 0.9), max(1.0, ui.em / 14))
            )


def frame(model: Growing) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the centre (3,), the radius around it, and the upward direction (3,) of a model that has cameras."""
    places = model.poses[:, :, 3].astype(np.float64)
    points = model.points.astype(np.float64)
    center = np.median(points, 0) if len(points) else places.mean(0)
    apart = np.linalg.norm(places - center, axis=1)
    radius = max(float(np.quantile(apart, 0.9)), 1e-6)
    up = model.poses[:, :, 1].astype(np.float64).sum(0)
    length = float(np.linalg.norm(up))
    return center, radius, up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])  # cameras of all attitudes


def _behind(model: Growing, center: np.ndarray) -> np.ndarray:
    """The direction (3,) from the centre to the cameras; one of a ring's that have no common side."""
    away = model.poses[:, :, 3].astype(np.float64) - center
    together = away.mean(0)
    return together if np.linalg.norm(together) > 0.3 * np.linalg.norm(away, axis=1).mean() else away[0]


def _camera(
    center: np.ndarray, radius: float, up: np.ndarray, behind: np.ndarray, time: float, size: tuple[int, int]
) -> Camera:
    ahead = behind - (behind @ up) * up
    if np.linalg.norm(ahead) <= 1e-3 * np.linalg.norm(behind):  # cameras straight above: any side is as good
        ahead = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    ahead /= np.linalg.norm(ahead)
    azimuth = SWING * math.sin(2 * math.pi * time / SWING_SECONDS)
    level = math.cos(azimuth) * ahead + math.sin(azimuth) * np.cross(up, ahead)
    back = math.cos(ELEVATION) * level + math.sin(ELEVATION) * up
    x = np.cross(up, back)
    x /= np.linalg.norm(x)
    focal = min(size) / 2 / math.tan(FIELD_OF_VIEW / 2)
    away = AWAY * radius / math.tan(FIELD_OF_VIEW / 2)
    c2w = np.column_stack([x, np.cross(back, x), back, center + away * back])
    return Camera(*size, focal, focal, size[0] / 2, size[1] / 2, c2w)


def splats(model: Growing, camera: Camera) -> np.ndarray:
    """Return a picture (H, W, 4) uint8 of the points, near ones over far ones; transparent elsewhere."""
    picture = np.zeros((camera.height, camera.width, 4), np.uint8)
    if len(model.points):
        pixels, depth = camera.project(model.points.astype(np.float64))
        order = np.argsort(-depth)
        column, row = np.floor(pixels[order]).astype(int).T
        seen = (depth[order] > 0) & (column >= 0) & (column < camera.width - SPLAT)
        seen &= (row >= 0) & (row < camera.height - SPLAT)
        colors = np.maximum(model.colors[order][seen], DIM)
        for dy in range(SPLAT):
            for dx in range(SPLAT):
                picture[row[seen] + dy, column[seen] + dx, :3] = colors
                picture[row[seen] + dy, column[seen] + dx, 3] = 255
    return picture
