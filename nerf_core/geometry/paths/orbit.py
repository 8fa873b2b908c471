"""A path around the scene's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths import PATHS, Option
from nerf_core.geometry.paths.llff import llff_path
from nerf_core.geometry.paths.steps import capture_distance, checked, pinhole, training_views
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import angles_from, rotation_from

# By default the camera looks down a little, so that the ground is visible.
ELEVATION = Option("Of an orbit, degrees above the horizon; by default 25.", 25.0, -90.0, 90.0, "°")
# float32 positions farther away cannot resolve the scene.
RADIUS = Option("Of an orbit, in scene units; by default the cameras' own distance.", capture_distance, 1e-4, 1e6)


@PATHS.register("orbit")
class Orbit:
    """One turn around the scene."""

    label: ClassVar[str] = marked("Orbit")
    summary: ClassVar[str] = "around the scene"
    default_frames: ClassVar[int] = 60
    options: ClassVar[Mapping[str, Option]] = {marked("elevation"): ELEVATION, marked("radius"): RADIUS}

    @staticmethod
    def cameras(
        scene: Scene,
        frames: int | None = None,
        width: int | None = None,
        height: int | None = None,
        *,
        elevation: float | None = None,
        radius: float | None = None,
    ) -> tuple[Camera, ...]:
        """Return one turn around scene.center about scene.up, which starts near the first training view.

        A scene in NDC ends at its frustum; it gets the path of LLFF instead.

        Args:
            scene: the scene.
            frames: the number of frames.
            width, height: the size of a frame in pixels; None takes the training photos' size.
            elevation: degrees above the horizon; None takes 25.
            radius: in scene units; None takes the cameras' median distance (`capture_distance`).

        Raises:
            UserError: for values without a path.
        """
        tilt = math.radians(ELEVATION.chosen("elevation", elevation, scene))
        distance = RADIUS.chosen("radius", radius, scene)
        if scene.ndc is not None:
            return llff_path(scene, frames, width, height)
        lens = pinhole(scene, width, height)
        count = checked(Orbit.default_frames if frames is None else frames, "frames")
        start = angles_from(training_views(scene)[0].camera.c2w[:, :3], scene.up)[0]
        path = []
        for k in range(count):
            rotation = rotation_from(start + 2 * math.pi * k / count, tilt, 0.0, scene.up)
            path.append(lens.moved(np.column_stack([rotation, scene.center + distance * rotation[:, 2]])))
        return tuple(path)
