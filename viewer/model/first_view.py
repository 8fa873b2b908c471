"""Points of view, and the one with which the window opens a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import angles_from, horizontal_axes, level, looking_along, rotation_from

STEEP = math.radians(75.0)  # of a photo that looks straight down: its direction no longer tells what is at the top
MAX_ELEVATION = math.radians(89.0)  # at 90° a sideways drag would spin the picture
SAMPLED = 100  # each of thousands of cameras is compared with so many
CANDIDATES = 1000  # photos, evenly spread, of which the most central one is looked for: 10,000 would take 0.3 s


@dataclass(frozen=True)
class Pose:
    """A point of view.

    rotation: (3, 3) camera to world.
    distance: from the eye (3,) forward to the pivot.
    """

    eye: np.ndarray
    rotation: np.ndarray
    distance: float
    fov_y_degrees: float

    @property
    def pivot(self) -> np.ndarray:
        return self.eye - self.distance * self.rotation[:, 2]


def around(pivot: np.ndarray, rotation: np.ndarray, distance: float, fov_y_degrees: float) -> Pose:
    """Return the point of view at a distance from a point (3,), which it looks at."""
    return Pose(pivot + distance * rotation[:, 2], rotation, distance, fov_y_degrees)


def most_central(cameras: Sequence[Camera], center: np.ndarray) -> int:
    """Index of the camera with the least total difference to the others in position and direction of view."""
    poses = np.stack([np.asarray(camera.c2w, np.float64) for camera in cameras])
    size = np.linalg.norm(poses[:, :, 3] - center, axis=1).mean() or 1.0
    features = np.concatenate([(poses[:, :, 3] - center) / size, poses[:, :, 2]], 1)
    candidates = np.linspace(0, len(features) - 1, min(CANDIDATES, len(features))).astype(int)
    others = features[np.linspace(0, len(features) - 1, min(SAMPLED, len(features))).astype(int)]
    return int(candidates[np.linalg.norm(features[candidates, None] - others, axis=-1).sum(1).argmin()])


def upright(photo: Pose, camera: Camera, scene: Scene, up: np.ndarray) -> Pose:
    """The first view: from a photo's place, without roll, turned to the scene's centre if the photo shows it there.

    A photo straight down is followed by a view straight down on the centre, with the photo's top at the top. The
    picture is as high as the photo, or as the square of its area for one in portrait: at its whole height, a wide
    window would show much beside it that no photo does, and at its width, it would cut off the subject.

    Args:
        photo: the point of view of the photo.
        camera: its camera.
        scene: the scene.
        up: its unit up direction (3,).
    """
    _, elevation, roll = angles_from(photo.rotation, up)
    wide, high = camera.width / camera.fx, camera.height / camera.fy
    if abs(math.sin(roll)) > math.cos(math.pi / 4):  # the camera was held on its side
        wide, high = high, wide
    fov = math.degrees(2 * math.atan(min(high, math.sqrt(wide * high)) / 2))
    center = np.asarray(scene.center, np.float64)
    pixels, depth = camera.project(center[None])
    shown = depth[0] > scene.near and (pixels[0] >= 0).all() and (pixels[0] < (camera.width, camera.height)).all()
    if abs(elevation) > STEEP:
        e1, e2, _ = horizontal_axes(up)
        outwards = -math.copysign(1.0, elevation) * photo.rotation[:, 1]
        rotation = rotation_from(
            math.atan2(outwards @ e2, outwards @ e1), math.copysign(MAX_ELEVATION, elevation), 0.0, up
        )
        return around(center if shown else photo.pivot, rotation, photo.distance, fov)
    if not shown:
        return replace(photo, rotation=level(photo.rotation, up), fov_y_degrees=fov)
    away = center - photo.eye
    distance = float(np.linalg.norm(away))
    rotation = looking_along(away / distance, photo.rotation, up)
    return Pose(photo.eye, rotation, distance, fov)
