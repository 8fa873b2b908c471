"""Camera paths to render as a video: around the scene, a spiral before it, through the held-out views."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene, View
from nerf_core.geometry.turntable import angles_from, rotation_from

ORBIT_ELEVATION = 25.0  # degrees: looks down a little, so that the ground gives the scene a hold
SPIRAL_TURNS = 2  # official LLFF: two turns, while the depth swings once, so the path closes
SPIRAL_FAR_SHARE = 0.75  # official LLFF: the focus lies 3/4 of the way, in disparity, to 5 × the far bound
FORWARD_COSINE = 0.5  # a capture whose views all lie within 60° of their mean is forward-facing
LOCAL_SPIRAL = 0.15  # radius over distance, where the capture surrounds the scene and has no mean view


def training_size(scene: Scene) -> tuple[int, int]:
    """Width and height that most training photos have."""
    return Counter((v.camera.width, v.camera.height) for v in _training(scene)).most_common(1)[0][0]


def capture_distance(scene: Scene) -> float:
    """The median distance of the training cameras to the scene's centre, in scene units.

    A capture that turned on the spot has none: there it is the scene's radius.
    """
    distances = [np.linalg.norm(v.camera.c2w[:, 3] - scene.center) for v in _training(scene)]
    median = float(np.median(distances))
    return median if median > 1e-6 * scene.radius else float(scene.radius)


def orbit(
    scene: Scene,
    frames: int | None = None,
    width: int | None = None,
    height: int | None = None,
    *,
    elevation_degrees: float = ORBIT_ELEVATION,
    radius: float | None = None,
    fov_y_degrees: float | None = None,
) -> tuple[Camera, ...]:
    """One turn around scene.center about scene.up, starting beside the first training view; 60 frames by default.

    radius: in scene units, by default the capture's own (`capture_distance`). width, height and the field of view
    default to the training photos'. A scene in NDC ends at its frustum, so there the path is `spiral`'s.
    Raises UserError for values that give no path.
    """
    if not -90 <= elevation_degrees <= 90:
        raise UserError(f"an orbit's elevation of {elevation_degrees:g}° does not exist: take one from -90 to 90")
    if radius is not None and not 0 < radius <= 1e6:  # beyond, float32 has no digits left for the scene
        raise UserError(f"an orbit's radius of {radius:g} is none: take a number of scene units from 0 to a million")
    if scene.ndc is not None:
        return spiral(scene, frames, width, height, fov_y_degrees=fov_y_degrees)
    lens = _lens(scene, width, height, fov_y_degrees)
    count = _checked(60 if frames is None else frames, "frames")
    distance = capture_distance(scene) if radius is None else radius
    start = angles_from(_training(scene)[0].camera.c2w[:, :3], scene.up)[0]
    elevation = math.radians(elevation_degrees)
    path = []
    for k in range(count):
        rotation = rotation_from(start + 2 * math.pi * k / count, elevation, 0.0, scene.up)
        path.append(lens.moved(np.column_stack([rotation, scene.center + distance * rotation[:, 2]])))
    return tuple(path)


def spiral(
    scene: Scene,
    frames: int | None = None,
    width: int | None = None,
    height: int | None = None,
    *,
    fov_y_degrees: float | None = None,
) -> tuple[Camera, ...]:
    """The official LLFF render path: two turns around the mean view, always looking at one focus; 120 by default.

    Position k lies at (r_x cos θ, −r_y sin θ, −r_z sin(θ/2)) in the mean camera's frame, r being the 90th
    percentiles of the cameras' distances from the mean along its axes, and looks at the point on the mean's
    axis at depth 1 / (0.25/near + 0.75/(5 far)) (render_path_spiral of the NeRF code). A capture that surrounds
    its scene has no mean view: there the spiral is a small one about its first view, focused at the centre's depth.
    """
    lens = _lens(scene, width, height, fov_y_degrees)
    count = _checked(120 if frames is None else frames, "frames")
    middle, radii, focus = _spiral_frame(scene)
    up = middle[:, 1]
    path = []
    for theta in 2 * np.pi * SPIRAL_TURNS * np.arange(count) / count:
        offset = radii * np.array([np.cos(theta), -np.sin(theta), -np.sin(theta / SPIRAL_TURNS)])
        position = middle[:, :3] @ offset + middle[:, 3]
        path.append(lens.moved(_look_at(position, focus, up)))
    return tuple(path)


def held_out_views(
    scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None
) -> tuple[Camera, ...]:
    """The held-out cameras in their order, each with its own lens; at most `frames` of them, by default all.

    A video has one size: cameras of another aspect keep their vertical field of view, unstretched.
    Raises UserError when the capture holds nothing out.
    """
    name, indices = scene.held_out()
    if not indices:
        raise UserError(f"scene {scene.name} has no {name} views to render: take the path orbit or spiral")
    chosen = indices if frames is None else indices[: _checked(frames, "frames")]
    size = _size(scene, width, height)
    return tuple(_fitted(scene.views[i].camera, *size) for i in chosen)


PATHS: dict[str, Callable[..., tuple[Camera, ...]]] = {"orbit": orbit, "spiral": spiral, "test": held_out_views}


def _training(scene: Scene) -> list[View]:
    return [scene.views[i] for i in scene.split("train")] or list(scene.views)


def _checked(value: int, name: str) -> int:
    if value < 1:
        raise UserError(f"a camera path of {value} {name} is empty: take 1 or more")
    return value


def _size(scene: Scene, width: int | None, height: int | None) -> tuple[int, int]:
    own = training_size(scene)
    return (
        own[0] if width is None else _checked(width, "pixels' width"),
        own[1] if height is None else _checked(height, "pixels' height"),
    )


def _fitted(camera: Camera, width: int, height: int) -> Camera:
    """The camera over width × height pixels: vertical field of view and the pixels' shape kept, sides cut or added."""
    scale = height / camera.height
    cx = width / 2 + (camera.cx - camera.width / 2) * scale
    resized = camera.resized(width, height)
    return replace(resized, fx=camera.fx * scale, cx=cx)


def _lens(scene: Scene, width: int | None, height: int | None, fov_y_degrees: float | None) -> Camera:
    """A pinhole without distortion at the origin: a path's cameras but for their poses."""
    width, height = _size(scene, width, height)
    own = training_size(scene)
    like = next(v.camera for v in _training(scene) if (v.camera.width, v.camera.height) == own)
    if fov_y_degrees is None:
        focal = like.fy * height / like.height
    elif 0 < fov_y_degrees < 180:
        focal = height / 2 / math.tan(math.radians(fov_y_degrees) / 2)
    else:
        raise UserError(f"a field of view of {fov_y_degrees:g}° shows nothing: take one between 0 and 180")
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4)[:3])


def _spiral_frame(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The spiral's middle camera (3, 4), its radii (3,) along that camera's axes, and the focus (3,)."""
    poses = np.stack([v.camera.c2w for v in _training(scene)])
    up, back, position = poses[:, :, 1:].mean(0).T
    # The mean of unit vectors is short where they disagree: then no direction, or no top, is common to the photos.
    agree = min(np.linalg.norm(up), np.linalg.norm(back)) > FORWARD_COSINE
    if agree and (poses[:, :, 2] @ back).min() > FORWARD_COSINE * np.linalg.norm(back):
        middle = _look_at(position, position - back, up)
        radii = np.percentile(np.abs((poses[:, :, 3] - position) @ middle[:, :3]), 90, axis=0)
        depth = 1 / ((1 - SPIRAL_FAR_SHARE) / scene.near + SPIRAL_FAR_SHARE / (5 * scene.far))
        return middle, radii, position - depth * middle[:, 2]
    first = poses[0]
    distance = capture_distance(scene)
    return first, np.full(3, LOCAL_SPIRAL * distance), first[:, 3] - distance * first[:, 2]


def _look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """c2w (3, 4) at `position` looking at `target`, the image's top towards `up` (not parallel to the view)."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])
