"""The render path of LLFF's captures, which several kinds of path offer."""

from __future__ import annotations

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths.steps import capture_distance, checked, pinhole, training_views
from nerf_core.geometry.scene import Scene

FRAMES = 120
TURNS = 2  # official LLFF: two turns while the depth oscillates once, so that the path closes
FAR_SHARE = 0.75  # official LLFF: in disparity, the focus lies 3/4 of the way to 5 × the far bound
FORWARD_COSINE = 0.5  # a capture whose views all lie within 60° of their mean is forward-facing
LOCAL_RADIUS = 0.15  # radius divided by distance, for a capture that surrounds the scene and has no mean view


def llff_path(
    scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None
) -> tuple[Camera, ...]:
    """Return the official LLFF render path: two turns around the mean view that always look at one focus.

    Frame k lies at (r_x cos θ, −r_y sin θ, −r_z sin(θ/2)) in the mean camera's frame. r is the 90th percentile of
    the cameras' distances from the mean along each axis. The focus lies on the mean camera's axis at depth
    1 / (0.25/near + 0.75/(5 far)) (render_path_spiral of the NeRF code). A capture that surrounds its scene has no
    mean view: it gets a small spiral about its first view, focused at the depth of the centre.
    """
    lens = pinhole(scene, width, height)
    count = checked(FRAMES if frames is None else frames, "frames")
    middle, radii, focus = _spiral_frame(scene)
    up = middle[:, 1]
    path = []
    for theta in 2 * np.pi * TURNS * np.arange(count) / count:
        offset = radii * np.array([np.cos(theta), -np.sin(theta), -np.sin(theta / TURNS)])
        position = middle[:, :3] @ offset + middle[:, 3]
        path.append(lens.moved(_look_at(position, focus, up)))
    return tuple(path)


def _spiral_frame(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The spiral's middle camera (3, 4), its radii (3,) along that camera's axes, and the focus (3,)."""
    poses = np.stack([v.camera.c2w for v in training_views(scene)])
    up, back, position = poses[:, :, 1:].mean(0).T
    # The mean of unit vectors is short where they disagree: the photos then have no common direction, or no common up.
    agree = min(np.linalg.norm(up), np.linalg.norm(back)) > FORWARD_COSINE
    if agree and (poses[:, :, 2] @ back).min() > FORWARD_COSINE * np.linalg.norm(back):
        middle = _look_at(position, position - back, up)
        radii = np.percentile(np.abs((poses[:, :, 3] - position) @ middle[:, :3]), 90, axis=0)
        depth = 1 / ((1 - FAR_SHARE) / scene.near + FAR_SHARE / (5 * scene.far))
        return middle, radii, position - depth * middle[:, 2]
    first = poses[0]
    distance = capture_distance(scene)
    return first, np.full(3, LOCAL_RADIUS * distance), first[:, 3] - distance * first[:, 2]


def _look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """c2w (3, 4) at `position` that looks at `target` with the image's top towards `up` (not parallel to the view)."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])
