"""A path around the scene's centre, over the side that photos show."""

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
from nerf_core.geometry.turntable import angles_from, rotation_from, widest_gap

WIDE_GAP = 90.0  # degrees of azimuth without a photo, from which an orbit leaves a side out: no photo saw what it shows
STEEP = 75.0  # degrees of elevation from which azimuth says little


def _photo_angles(scene: Scene) -> np.ndarray:
    """Azimuths and elevations (2, N) of the training cameras, as seen from what they look at, in degrees."""
    angles = [angles_from(view.camera.c2w[:, :3], scene.up)[:2] for view in training_views(scene)]
    return np.degrees(np.array(angles).T)


def _middle_and_arc(scene: Scene) -> tuple[float, float]:
    """The middle azimuth and the width of the side that photos show, in degrees."""
    azimuths, elevations = _photo_angles(scene)
    begin, gap = widest_gap(azimuths[np.abs(elevations) < STEEP])
    return begin + gap + (360 - gap) / 2, 360 - gap


def photographed_arc(scene: Scene) -> float:
    """Return the degrees of azimuth that an orbit covers by default: 360, less a wide gap that no photo looks from.

    Photos that all look the same way leave no arc. They get a whole turn.
    """
    arc = _middle_and_arc(scene)[1]
    return arc if 1 <= arc <= 360 - WIDE_GAP else 360.0


def photographed_elevation(scene: Scene) -> float:
    """Return the median elevation in degrees from which the training cameras look."""
    return float(np.median(_photo_angles(scene)[1]))


ARC = Option(
    "Of an orbit, degrees around the scene; less than 360 goes to and fro. By default the side that photos show.",
    photographed_arc, 1.0, 360.0, "°",
)  # fmt: skip
ELEVATION = Option(
    "Of an orbit, degrees above the horizon; by default the photos' median.", photographed_elevation, -90.0, 90.0, "°"
)
# float32 positions farther away cannot resolve the scene.
RADIUS = Option("Of an orbit, in scene units; by default the cameras' own distance.", capture_distance, 1e-4, 1e6)


@PATHS.register("orbit")
class Orbit:
    """Around the scene, or to and fro before the side that photos show."""

    label: ClassVar[str] = marked("Orbit")
    summary: ClassVar[str] = "around the scene"
    default_frames: ClassVar[int] = 60
    options: ClassVar[Mapping[str, Option]] = {
        marked("arc"): ARC, marked("elevation"): ELEVATION, marked("radius"): RADIUS
    }  # fmt: skip

    @staticmethod
    def cameras(
        scene: Scene,
        frames: int | None = None,
        width: int | None = None,
        height: int | None = None,
        *,
        arc: float | None = None,
        elevation: float | None = None,
        radius: float | None = None,
    ) -> tuple[Camera, ...]:
        """Return a path around scene.center about scene.up that closes. It starts near the first training view.

        A whole turn has equal steps. A smaller arc of width a around azimuth m goes to and fro:
        azimuth(k) = m + a/2 sin(φ + 2πk/frames). A scene in NDC ends at its frustum; it gets the path of LLFF instead.

        Args:
            scene: the scene.
            frames: the number of frames.
            width, height: the size of a frame in pixels; None takes the training photos' size.
            arc: degrees of azimuth; None takes `photographed_arc`.
            elevation: degrees above the horizon; None takes `photographed_elevation`.
            radius: in scene units; None takes the cameras' median distance (`capture_distance`).

        Raises:
            UserError: for values without a path.
        """
        whole = ARC.chosen("arc", arc, scene)
        tilt = math.radians(ELEVATION.chosen("elevation", elevation, scene))
        distance = RADIUS.chosen("radius", radius, scene)
        if scene.ndc is not None:
            return llff_path(scene, frames, width, height)
        lens = pinhole(scene, width, height)
        count = checked(Orbit.default_frames if frames is None else frames, "frames")
        path = []
        for azimuth in np.radians(_azimuths(scene, count, whole)):
            rotation = rotation_from(azimuth, tilt, 0.0, scene.up)
            path.append(lens.moved(np.column_stack([rotation, scene.center + distance * rotation[:, 2]])))
        return tuple(path)


def _azimuths(scene: Scene, count: int, arc: float) -> np.ndarray:
    """The azimuth (count,) of each frame, in degrees."""
    start = _photo_angles(scene)[0, 0]
    turn = np.arange(count) / count
    if arc == 360:
        return start + 360 * turn
    middle = _middle_and_arc(scene)[0]
    off = (start - middle + 180) % 360 - 180
    return middle + arc / 2 * np.sin(math.asin(np.clip(2 * off / arc, -1, 1)) + 2 * math.pi * turn)
