"""Show a training photo where there is no picture of the model yet."""

from __future__ import annotations

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene

from ..ui.contract import Ui
from ..ui.widgets import packed

DIMMED = ImVec4(0.45, 0.45, 0.45, 1.0)  # so that nobody takes the photo for what the model has learnt
TEXTURE = "viewport.photo"


def nearest_photo(scene: Scene, camera: Camera) -> int | None:
    """Return the index of the training photo that was taken from nearest to a camera; None if there is none.

    Photos of a large capture that are still to be read do not count.

    The distance is that of the centres in units of the scene's radius, plus one minus the cosine of the angle between
    the directions in which they look.
    """
    train = np.array(scene.split("train"), np.int64)
    train = train[scene.photos.at(train.tolist()).present()]
    if not len(train):
        return None
    c2w = scene.poses[train]
    apart = np.linalg.norm(c2w[:, :, 3] - camera.c2w[:, 3], axis=1) / scene.radius
    return int(train[np.argmin(apart + 1 - c2w[:, :, 2] @ camera.c2w[:, 2])])


class NearestPhoto:
    """Draws the photo that is nearest to the camera, dimmed, in the middle of the viewport."""

    def __init__(self) -> None:
        self._made: tuple[Scene, int, np.ndarray] | None = None

    def draw(self, ui: Ui, draw: imgui.ImDrawList, scene: Scene, camera: Camera, origin: ImVec2) -> str:
        """Draw it as large as fits into the viewport; return the photo's name, "" if there is none."""
        index = nearest_photo(scene, camera)
        if index is None:
            return ""
        if self._made is None or self._made[0] is not scene or self._made[1] != index:
            self._made = scene, index, scene.photos.small(index, max(camera.width, camera.height))
        rgba = self._made[2]
        scale = min(camera.width / rgba.shape[1], camera.height / rgba.shape[0])
        width, height = rgba.shape[1] * scale, rgba.shape[0] * scale
        low = ImVec2(origin.x + (camera.width - width) / 2, origin.y + (camera.height - height) / 2)
        high = ImVec2(low.x + width, low.y + height)
        ends = ImVec2(0, 0), ImVec2(1, 1)
        draw.add_image(ui.texture(TEXTURE, rgba), low, high, *ends, packed(DIMMED))
        return scene.views[index].name
