"""The user's camera: orbit, fly, pan, zoom, focus. It uses only numpy, and the caller passes the time.

Pixels are those of the viewport, x right and y down from its top left. In each frame the app passes on the user's
movements and then calls `update(time)` once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths.steps import capture_distance
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import angles_from, level, looking_along, rotation_from

from .first_view import MAX_ELEVATION, Pose, around, most_central, upright

EASE_SECONDS = 0.2
MOVING_SECONDS = 0.15  # longer than the gap between two mouse events, shorter than a delay that one notices
ZOOM_STEP = 0.88  # factor on the distance for one notch of the wheel
ORBIT_TURN = math.pi  # radians for a drag as long as the viewport's height
ROLL_FADE = 0.1  # radians of orbiting after which the roll of a photo's camera has fallen to 1/e
FLY_SPEED, FLY_FAST = 0.6, 5.0  # scene radii per second; Shift multiplies it by the second number
FLY_LONGEST = 0.1  # seconds: limits the camera's step after a slow frame
NEAREST, FARTHEST = 1e-3, 100.0  # the wheel's limits for the distance from eye to pivot, in scene radii


def _pleasant(center: np.ndarray, up: np.ndarray, distance: float) -> Pose:
    return around(center, rotation_from(math.radians(-60), math.radians(25), 0.0, up), distance, 40.0)


def _blend(a: Pose, b: Pose, share: float, up: np.ndarray) -> Pose:
    """Interpolate between two poses around their pivots, upright all the way. A turn on the spot keeps the eye."""

    def mix(x: float, y: float) -> float:
        return x + share * (y - x)

    def turn(x: float, y: float) -> float:
        return x + share * ((y - x + math.pi) % (2 * math.pi) - math.pi)

    (azimuth, elevation, roll), (azimuth2, elevation2, roll2) = angles_from(a.rotation, up), angles_from(b.rotation, up)
    rotation = rotation_from(turn(azimuth, azimuth2), mix(elevation, elevation2), turn(roll, roll2), up)
    pose = around(
        a.pivot + share * (b.pivot - a.pivot),
        rotation,
        mix(a.distance, b.distance),
        mix(a.fov_y_degrees, b.fov_y_degrees),
    )
    return replace(pose, eye=a.eye) if np.array_equal(a.eye, b.eye) else pose


@dataclass
class _Ease:
    start: Pose
    end: Pose
    began: float | None = None  # time of the first update after the jump, because the user has seen nothing before it


@dataclass
class CameraControl:
    """The user's camera. Without a scene it circles the origin.

    Orbit, pan, zoom and fly act at once and stop a jump. The other movements are jumps with easing.
    """

    scene: Scene | None = field(default=None, init=False)
    _up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]), init=False)
    _unit: float = field(default=1.0, init=False)  # the scene's radius
    _home: Pose = field(init=False)
    _pose: Pose = field(init=False)
    _ease: _Ease | None = field(default=None, init=False)
    _touched: bool = field(default=False, init=False)
    _changed_at: float = field(default=-math.inf, init=False)

    def __post_init__(self) -> None:
        self._home = self._pose = _pleasant(np.zeros(3), self._up, 4.0)

    # ---- what the camera is ----------------------------------------------------------------------------------

    @property
    def pivot(self) -> np.ndarray:
        """The world point (3,) that the camera orbits."""
        return self._pose.pivot

    @property
    def distance(self) -> float:
        """The distance from the eye to the pivot, in scene units."""
        return self._pose.distance

    @property
    def fov_y_degrees(self) -> float:
        return self._pose.fov_y_degrees

    def c2w(self) -> np.ndarray:
        """Return camera-to-world, (3, 4) float64, OpenGL axes, orthonormal rotation."""
        return np.column_stack([self._pose.rotation, self._pose.eye])

    def camera(self, width: int, height: int) -> Camera:
        """Return a pinhole camera with width × height ≥ 1 pixels and the same vertical field of view for any size."""
        focal = height / 2 / math.tan(math.radians(self.fov_y_degrees) / 2)
        return Camera(width, height, focal, focal, width / 2, height / 2, self.c2w())

    def update(self, time: float) -> bool:
        """Continue a jump. Returns whether the camera has moved since the last call, or is about to."""
        moved, self._touched = self._touched, False
        if self._ease is not None:
            moved = True
            ease = self._ease
            if ease.began is None:
                ease.began = time
            part = max(0.0, (time - ease.began) / EASE_SECONDS)
            if part >= 1:
                self._pose, self._ease = ease.end, None
            else:
                self._pose = _blend(ease.start, ease.end, part * part * (3 - 2 * part), self._up)
        if moved:
            self._changed_at = time
        return moved

    @property
    def flying(self) -> bool:
        """True during a jump."""
        return self._ease is not None

    def moving(self, time: float) -> bool:
        """Return whether the last change is so recent that another may follow."""
        return time - self._changed_at < MOVING_SECONDS

    # ---- movements of the user -------------------------------------------------------------------------------

    def orbit(self, dx: float, dy: float, height: int) -> None:
        """Orbit the pivot after a drag of (dx, dy) pixels. It stops before the pole, and a photo's roll fades."""
        azimuth, elevation, roll = angles_from(self._pose.rotation, self._up)
        scale = ORBIT_TURN / height
        elevation = float(np.clip(elevation + dy * scale, -MAX_ELEVATION, MAX_ELEVATION))
        roll *= math.exp(-math.hypot(dx, dy) * scale / ROLL_FADE)
        rotation = rotation_from(azimuth - dx * scale, elevation, roll, self._up)
        self._move(around(self.pivot, rotation, self.distance, self.fov_y_degrees))

    def pan(self, dx: float, dy: float, height: int) -> None:
        """Move sideways so that a point at the pivot's depth follows a pointer that moved by (dx, dy) pixels."""
        pixel = self._pixel(height)
        shift = self._pose.rotation @ (pixel * np.array([-dx, dy, 0.0]))
        self._move(replace(self._pose, eye=self._pose.eye + shift))

    def zoom(self, steps: float, x: float, y: float, width: int, height: int) -> None:
        """Approach the point under the pointer at the pivot's depth, but never pass it. Negative steps retreat."""
        distance = self.distance
        wanted = distance * ZOOM_STEP**steps
        # A focus may lie outside the wheel's limits; from there the wheel only leads back.
        wanted = float(np.clip(wanted, min(NEAREST * self._unit, distance), max(FARTHEST * self._unit, distance)))
        pixel = self._pixel(height)
        under = np.array([(x - width / 2) * pixel, (height / 2 - y) * pixel, -distance])
        eye = self._pose.eye + self._pose.rotation @ under * (1 - wanted / distance)
        self._move(replace(self._pose, eye=eye, distance=wanted))

    def fly(self, right: float, up: float, forward: float, seconds: float, fast: bool = False) -> None:
        """Fly for `seconds` along the camera's right and view axes and the scene's up (−1, 0 or 1 each, from keys)."""
        direction = self._pose.rotation @ np.array([right, 0.0, -forward]) + up * self._up
        length = np.linalg.norm(direction)
        if length == 0:
            return
        speed = FLY_SPEED * self._unit * (FLY_FAST if fast else 1.0)
        step = speed * min(seconds, FLY_LONGEST) * direction / length
        self._move(replace(self._pose, eye=self._pose.eye + step))

    # ---- jumps -----------------------------------------------------------------------------------------------

    def set_scene(self, scene: Scene) -> None:
        """Start, without easing, at a training photo's place, level; without photos, at a pleasant distance.

        For a synthetic object, seen from all around, it is the first photo. For a place it is the photo that is most
        similar to the others, because the content is what most photos show.
        """
        self.scene = scene
        self._up = np.asarray(scene.up, np.float64) / np.linalg.norm(scene.up)
        # A capture without extent (all cameras in one place, no points) has no scale.
        self._unit = float(scene.radius) if scene.radius > 0 else 1.0
        train = scene.split("train")
        if train:
            cameras = [scene.views[i].camera for i in train]
            camera = cameras[0] if scene.synthetic else cameras[most_central(cameras, scene.center)]
            self._home = upright(self._photo(camera), camera, scene, self._up)
        else:
            self._home = _pleasant(np.asarray(scene.center, np.float64), self._up, 3 * self._unit)
        self._ease = None
        self._move(self._home)

    @property
    def moved(self) -> bool:
        """Whether the camera is elsewhere than `reset` puts it."""
        pose, home = self._pose, self._home
        return not (np.array_equal(pose.eye, home.eye) and np.array_equal(pose.rotation, home.rotation))

    def reset(self) -> None:
        """Return to the first view of the scene."""
        self._jump(self._home)

    def frame(self) -> None:
        """Show the whole scene from the current side, at the distance of the photos.

        A forward-facing scene can only be seen from its cameras' side: there it does the same as `reset`.
        """
        if self.scene is None or self.scene.ndc is not None:
            self.reset()
            return
        rotation = level(self._pose.rotation, self._up)
        distance = max(capture_distance(self.scene), NEAREST * self._unit)
        self._jump(around(np.asarray(self.scene.center, np.float64), rotation, distance, self._home.fov_y_degrees))

    def look(self, rotation: np.ndarray, radii: float | None = None) -> None:
        """Look at the scene's middle.

        rotation: (3, 3) camera to world. radii: the distance in radii of the scene; None: the one of the photos.
        """
        if self.scene is None:
            return
        distance = capture_distance(self.scene) if radii is None else radii * self._unit
        center = np.asarray(self.scene.center, np.float64)
        self._jump(around(center, rotation, max(distance, NEAREST * self._unit), self._home.fov_y_degrees))

    def focus(self, point: np.ndarray) -> None:
        """Turn to a world point (3,) and orbit it from now on. Ignore a point that is not finite: nothing was hit."""
        if not np.isfinite(point).all():
            return
        to_point = np.asarray(point, np.float64) - self._pose.eye
        distance = float(np.linalg.norm(to_point))
        nearest = NEAREST * self._unit
        if distance < nearest:  # the eye is at the point and there is no direction to turn to, so step back
            rotation = level(self._pose.rotation, self._up)
            self._jump(around(np.asarray(point, np.float64), rotation, nearest, self.fov_y_degrees))
            return
        rotation = looking_along(to_point / distance, self._pose.rotation, self._up)
        self._jump(replace(self._pose, rotation=rotation, distance=distance))

    def go_to(self, camera: Camera) -> None:
        """Fly to a photo's camera: to its exact pose, with roll, and its vertical field of view."""
        self._jump(self._photo(camera))

    def _pixel(self, height: int) -> float:
        """The size of a pixel at the pivot's depth, in scene units."""
        return 2 * self.distance * math.tan(math.radians(self.fov_y_degrees) / 2) / height

    def _photo(self, camera: Camera) -> Pose:
        """A photo's point of view. The pivot is the point of its axis nearest to the scene's centre."""
        c2w = np.asarray(camera.c2w, np.float64)
        distance = self._unit
        if self.scene is not None:
            depth = float((c2w[:, 3] - self.scene.center) @ c2w[:, 2])
            distance = (
                depth if depth > NEAREST * self._unit else self._unit
            )  # the centre lies behind: the photo looks out of the scene
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        return Pose(c2w[:, 3].copy(), c2w[:, :3].copy(), distance, fov)

    def _move(self, pose: Pose) -> None:
        self._pose, self._ease, self._touched = pose, None, True

    def _jump(self, pose: Pose) -> None:
        self._ease, self._touched = _Ease(self._pose, pose), True
