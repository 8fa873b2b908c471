"""Helpers that the camera paths share."""

from __future__ import annotations

from collections import Counter

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene, View


def training_size(scene: Scene) -> tuple[int, int]:
    """Return the width and height of most training photos."""
    return Counter((v.camera.width, v.camera.height) for v in training_views(scene)).most_common(1)[0][0]


def capture_distance(scene: Scene) -> float:
    """Return the median distance of the training cameras from the scene's centre, in scene units.

    It is the scene's radius for a camera that only turned on the spot.
    """
    distances = [np.linalg.norm(v.camera.c2w[:, 3] - scene.center) for v in training_views(scene)]
    median = float(np.median(distances))
    return median if median > 1e-6 * scene.radius else float(scene.radius)


def training_views(scene: Scene) -> list[View]:
    """Return the views of the training split, or all views of a scene without one."""
    return [scene.views[i] for i in scene.split("train")] or list(scene.views)


def checked(value: int, name: str) -> int:
    """Return `value`. Raises UserError if it is below 1."""
    if value < 1:
        raise UserError(f"a camera path of {value} {name} is empty: take 1 or more")
    return value


def video_size(scene: Scene, width: int | None, height: int | None) -> tuple[int, int]:
    """Return the width and height of a path's frames: those given, else those of most training photos."""
    own = training_size(scene)
    return (
        own[0] if width is None else checked(width, "pixels' width"),
        own[1] if height is None else checked(height, "pixels' height"),
    )


def pinhole(scene: Scene, width: int | None, height: int | None) -> Camera:
    """Return a pinhole camera at the origin, with the training photos' field of view.

    A path's cameras are this one at other poses.
    """
    width, height = video_size(scene, width, height)
    own = training_size(scene)
    like = next(v.camera for v in training_views(scene) if (v.camera.width, v.camera.height) == own)
    focal = like.fy * height / like.height
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4)[:3])
