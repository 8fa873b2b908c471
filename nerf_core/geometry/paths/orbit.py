"""A path around the scene's centre, over the side that photos show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR
from nerf_core.geometry.paths import PATHS, Option
from nerf_core.geometry.paths.llff import llff_path
from nerf_core.geometry.paths.steps import capture_distance, checked, pinhole, training_views
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import STEEP, horizontal_axes, rotation_from

WIDE_GAP = 90.0  # degrees of azimuth without a photo, from which an orbit leaves a side out: no photo saw what it shows
LEAST_ARC = 20.0  # degrees: photos that look from one place alone would give a film in which nothing moves
ALIKE = 1e-6  # degrees by which the gaps of a regular ring differ through rounding
FROM_ABOVE = 25.0  # degrees of elevation if no photo tells one


class Side(NamedTuple):
    """From where photos show the scene's centre, in degrees.

    start: the azimuth of the first training photo. middle, arc: the azimuth in the middle of the side, and its width.
    elevation: the median.
    """

    start: float
    middle: float
    arc: float
    elevation: float


def photographed(scene: Scene) -> Side:
    """Find the side from which training photos show the scene: all around, unless gaps of azimuth are too wide.

    Between wide gaps, the side with most photos counts; of equals that of the first photo. Photos that mostly look
    straight down or up show it from all around.
    """
    outwards = _outwards(scene)
    if not len(outwards):
        return Side(0.0, 0.0, 360.0, FROM_ABOVE)
    e1, e2, up = horizontal_axes(scene.up)
    x, y, height = outwards @ e1, outwards @ e2, outwards @ up
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(height, np.hypot(x, y)))
    start, median = float(azimuth[0]), float(np.median(elevation))
    flat = np.abs(elevation) < STEEP
    if flat.mean() < 0.5:
        return Side(start, start, 360.0, median)
    order = np.argsort(azimuth[flat], kind="stable")
    ordered = azimuth[flat][order]
    gaps = np.diff(np.append(ordered, ordered[0] + 360))
    wide = np.flatnonzero(gaps > WIDE_GAP + ALIKE)
    if not len(wide):
        return Side(start, start, 360.0, median)
    begins, ends = (np.roll(wide, 1) + 1) % len(ordered), wide  # of each side, as positions in `ordered`
    counts = (ends - begins) % len(ordered) + 1
    first = (int(np.flatnonzero(order == 0)[0]) - begins) % len(ordered) < counts  # whether the first photo is there
    best = int(np.argmax(counts + 0.5 * first))
    arc = float(ordered[ends[best]] - ordered[begins[best]]) % 360
    return Side(start, float(ordered[begins[best]]) + arc / 2, max(arc, LEAST_ARC), median)


def _outwards(scene: Scene) -> np.ndarray:
    """Unit vectors (N, 3) from the scene's centre to where training photos show it from.

    A photo whose camera looks away from the centre shows what lies behind it, as cameras in the middle of a room do:
    there it is the camera's direction. A panorama around the centre shows it from everywhere, and is left out.
    """
    cameras = [view.camera for view in training_views(scene)]
    poses = np.stack([camera.c2w for camera in cameras])
    offsets, backs = poses[:, :, 3] - scene.center, poses[:, :, 2]
    apart = np.linalg.norm(offsets, axis=1)
    around = np.array([camera.lens.kind == EQUIRECTANGULAR for camera in cameras])
    placed = apart > 1e-6 * scene.radius
    towards = placed & (around | ((offsets * backs).sum(1) > 0))
    outwards = np.where(towards[:, None], offsets / np.where(placed, apart, 1)[:, None], backs)
    return outwards[towards | ~around]


def photographed_arc(scene: Scene) -> float:
    """Return the degrees of azimuth that an orbit covers by default; see `photographed`."""
    return photographed(scene).arc


def photographed_elevation(scene: Scene) -> float:
    """Return the median elevation in degrees from which training photos show the scene."""
    return photographed(scene).elevation


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
        width_of_arc = ARC.chosen("arc", arc, scene)
        tilt = math.radians(ELEVATION.chosen("elevation", elevation, scene))
        distance = RADIUS.chosen("radius", radius, scene)
        if scene.ndc is not None:
            return llff_path(scene, frames, width, height)
        lens = pinhole(scene, width, height)
        count = checked(Orbit.default_frames if frames is None else frames, "frames")
        path = []
        for azimuth in np.radians(_azimuths(photographed(scene), count, width_of_arc)):
            rotation = rotation_from(azimuth, tilt, 0.0, scene.up)
            path.append(lens.moved(np.column_stack([rotation, scene.center + distance * rotation[:, 2]])))
        return tuple(path)


def _azimuths(side: Side, count: int, arc: float) -> np.ndarray:
    """The azimuth (count,) of each frame, in degrees."""
    turn = np.arange(count) / count
    if arc == 360:
        return side.start + 360 * turn
    off = (side.start - side.middle + 180) % 360 - 180
    return side.middle + arc / 2 * np.sin(math.asin(np.clip(2 * off / arc, -1, 1)) + 2 * math.pi * turn)
