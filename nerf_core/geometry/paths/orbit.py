"""A path around the scene's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.paths.steps import capture_distance, checked, pinhole, training_views
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import angles_from, rotation_from

ELEVATION = 25.0  # degrees: the camera looks down a little, so that the ground is visible


@PATHS.register("orbit")
class Orbit:
    """One turn around the scene."""

    label: ClassVar[str] = "Orbit"
    summary: ClassVar[str] = "around the scene"
    default_frames: ClassVar[int] = 60
    options: ClassVar[Mapping[str, str]] = {
        "elevation": "Of an orbit, degrees above the horizon; by default 25.",
        "radius": "Of an orbit, in scene units; by default the cameras' own distance.",
    }

    @staticmethod
    def cameras(
        scene: Scene,
        frames: int | None = None,
        width: int | None = None,
        height: int | None = None,
        *,
        elevation: float = ELEVATION,
        radius: float | None = None,
        fov_y_degrees: float | None = None,
    ) -> tuple[Camera, ...]:
        """Return one turn around scene.center about scene.up, which starts near the first training view.

        A scene in NDC ends at its frustum; it gets the path of `spiral` instead.

        Args:
            scene: the scene.
            frames: the number of frames.
            width, height: the size of a frame in pixels; None takes the training photos' size.
            elevation: degrees above the horizon.
            radius: in scene units; None takes the cameras' median distance (`capture_distance`).
            fov_y_degrees: the vertical field of view; None takes the training photos'.

        Raises:
            UserError: for values without a path.
        """
        if not -90 <= elevation <= 90:
            raise UserError(f"an orbit's elevation of {elevation:g}° does not exist: take one from -90 to 90")
        if radius is not None and not 0 < radius <= 1e6:  # farther away, float32 positions cannot resolve the scene
            raise UserError(
                f"an orbit's radius of {radius:g}: it must be greater than 0 and at most a million scene units"
            )
        if scene.ndc is not None:
            return PATHS.get("spiral").cameras(scene, frames, width, height, fov_y_degrees=fov_y_degrees)
        lens = pinhole(scene, width, height, fov_y_degrees)
        count = checked(Orbit.default_frames if frames is None else frames, "frames")
        distance = capture_distance(scene) if radius is None else radius
        start = angles_from(training_views(scene)[0].camera.c2w[:, :3], scene.up)[0]
        tilt = math.radians(elevation)
        path = []
        for k in range(count):
            rotation = rotation_from(start + 2 * math.pi * k / count, tilt, 0.0, scene.up)
            path.append(lens.moved(np.column_stack([rotation, scene.center + distance * rotation[:, 2]])))
        return tuple(path)
