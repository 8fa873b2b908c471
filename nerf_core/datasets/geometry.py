"""Transform a capture from the input's frame to the trainer's: find centre, size and up direction, or set up NDC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase
from nerf_core.datasets.capture import Capture, LoadOptions
from nerf_core.datasets.depths import Depths, known_depths
from nerf_core.datasets.rig import as_held, common_focus, spread, up_direction, upright
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.forward_facing import mean_camera, turned_away
from nerf_core.geometry.ndc import Ndc

SYNTHETIC_DEPTHS = (2.0, 6.0)  # of the official Blender configurations
ANOTHER_UNIT = 10.0  # times farther or nearer than that, an object has another unit: γ of networks needs some units
NDC_NEAR_BOUND = 0.75  # official LLFF: the nearest content lies at 1/0.75, so beyond the near plane at 1
LONGEST = np.pi  # the official encoding γ has no factor π: its lowest frequency is unique within ±π
SHRINK = 2.0  # the largest scaling that fits a far background into ±π; more would lose detail at the centre
NO_DEPTHS_NEAR = (
    0.25  # of the depth of the focus, if no depths are known: content may reach 3/4 of the way to the cameras
)
NO_DEPTHS_REACH = 5.0  # of the cameras' spread, if they do not look at one point either
FORWARD = 0.5  # the least length of the mean view direction: all views within 60° of it reach this


@dataclass(frozen=True)
class Normalised:
    """A capture's cameras in the trainer's frame; the other fields are those of `nerf_core.geometry.scene.Scene`."""

    cameras: tuple[Camera, ...]
    near: float
    far: float
    ndc: Ndc | None
    disparity: bool
    center: np.ndarray
    radius: float
    up: np.ndarray
    to_input: np.ndarray
    notes: tuple[str, ...] = ()


def normalise(capture: Capture, options: LoadOptions) -> Normalised:
    """Move, rotate and scale a capture into the trainer's frame, with one similarity.

    Synthetic captures keep their frame, and their unit if it is about the usual one. NDC uses the official LLFF frame:
    the mean camera lies at the origin and looks along −z, y is up, and the nearest bound is at 1/0.75. All other
    captures have the point that their cameras look at as the origin, z up, and the cameras at an RMS distance of 1
    (official spherify; smaller for a far background).
    Raises UserError for `ndc="on"` where it is impossible, and for lengths that floats cannot hold.
    """
    poses = np.stack([photo.camera.c2w for photo in capture.photos])
    depths = known_depths(capture)
    notes: tuple[str, ...] = ()
    if options.ndc == "on" or (options.ndc == "auto" and capture.ndc_capable and depths is not None):
        obstacle = _ndc_obstacle(capture, poses, depths)
        if obstacle and options.ndc == "on":
            raise UserError(f"--ndc on is impossible: {obstacle}; take --ndc auto or off")
        if obstacle:
            notes = (phrase("NDC is not taken: {obstacle}", obstacle=obstacle),)
        elif depths is not None:
            return _checked(_in_ndc(capture, poses, depths))
    done = _synthetic(capture, poses) if capture.synthetic else _real(capture, poses, depths)
    return _checked(replace(done, notes=notes + done.notes))


def _checked(done: Normalised) -> Normalised:
    """Raise UserError unless all lengths are finite and 0 < near < far as float32."""
    with np.errstate(over="ignore", under="ignore"):
        near, far, radius = (np.float32(v) for v in (done.near, done.far, done.radius))
        positions = np.stack([c.c2w[:, 3] for c in done.cameras]).astype(np.float32)
    finite = np.isfinite(positions).all() and np.isfinite(done.to_input).all()
    if not (finite and 0 < near < far < np.inf and 0 < radius < np.inf):
        raise UserError(
            f"the capture's lengths span too many magnitudes (content from {done.near:.3g} to {done.far:.3g}, cameras "
            f"{done.radius:.3g} from it): check its camera positions and bounds"
        )
    return done


def _placed(
    cameras: Sequence[Camera], rotation: np.ndarray, center: np.ndarray, scale: float
) -> tuple[tuple[Camera, ...], np.ndarray]:
    """The cameras transformed by x → scale · rotation (x − center), and the (4, 4) inverse."""
    to_input = np.eye(4)
    to_input[:3, :3], to_input[:3, 3] = rotation.T / scale, center
    moved = [
        c.moved(np.column_stack([rotation @ c.c2w[:, :3], scale * (rotation @ (c.c2w[:, 3] - center))]))
        for c in cameras
    ]
    return tuple(moved), to_input


# ---- normalised device coordinates -----------------------------------------------------------------------------


def _ndc_obstacle(capture: Capture, poses: np.ndarray, depths: Depths | None) -> str:
    """Why NDC cannot be used; empty if it can."""
    if depths is None:
        return "the nearest content is unknown, as the capture has neither depth bounds nor sparse points"
    mean = mean_camera(poses)
    if mean is None:
        return "the cameras have no mean direction of view"
    turned = turned_away([photo.camera for photo in capture.photos], mean[:, 2])
    if turned:
        return f"{turned} of {len(poses)} cameras have rays that do not point along the mean view"
    return ""


def _in_ndc(capture: Capture, poses: np.ndarray, depths: Depths) -> Normalised:
    """Scale the poses by 1/(0.75 · nearest bound) and centre them on the mean camera (official LLFF loader)."""
    mean = mean_camera(poses)
    assert mean is not None  # `_ndc_obstacle` has checked it
    scale = 1 / (NDC_NEAR_BOUND * depths.closest)
    cameras, to_input = _placed([photo.camera for photo in capture.photos], mean[:, :3].T, mean[:, 3], scale)
    widest = max(
        cameras, key=lambda c: c.width / c.fx * (c.height / c.fy)
    )  # so that no photo extends far beyond [−1, 1]²
    focal = float(np.sqrt(widest.fx * widest.fy))
    return Normalised(
        cameras=cameras,
        near=depths.near * scale,
        far=depths.far * scale,
        ndc=Ndc(widest.width, widest.height, focal, near=1.0, far=depths.far * scale),
        disparity=False,
        center=np.array([0.0, 0.0, -depths.middle * scale]),
        radius=depths.middle * scale,
        up=_ndc_up(capture, mean),
        to_input=to_input,
    )


def _ndc_up(capture: Capture, mean: np.ndarray) -> np.ndarray:
    """Up in the frame of the mean camera (3, 4): y, or the side that EXIF names for most photos taken as stored."""
    if all(photo.orientation == 1 for photo in capture.photos):
        return np.array([0.0, 1.0, 0.0])
    x, y, _ = mean[:, :3].T @ _held(capture)[:, :, 1].mean(0)
    return np.array([0.0, np.sign(y) or 1.0, 0.0]) if abs(y) >= abs(x) else np.array([np.sign(x), 0.0, 0.0])


# ---- captures in world space -----------------------------------------------------------------------------------


def _synthetic(capture: Capture, poses: np.ndarray) -> Normalised:
    near, far = capture.near, capture.far
    if near is None or far is None:
        near, far = SYNTHETIC_DEPTHS
    focus = common_focus(poses)
    center = np.zeros(3) if focus is None else focus
    scale = sum(SYNTHETIC_DEPTHS) / (near + far)
    cameras, to_input = tuple(photo.camera for photo in capture.photos), np.eye(4)
    if 1 / ANOTHER_UNIT <= scale <= ANOTHER_UNIT:
        scale = 1.0
    else:
        cameras, to_input = _placed(cameras, np.eye(3), np.zeros(3), scale)
    return Normalised(
        cameras=cameras,
        near=near * scale,
        far=far * scale,
        ndc=None,
        disparity=False,
        center=center * scale,
        radius=_orbit_radius(poses[:, :, 3], center, (near + far) / 2) * scale,
        up=np.array([0.0, 0.0, 1.0]) if capture.up is None else capture.up,
        to_input=to_input,
    )


def _held(capture: Capture) -> np.ndarray:
    """The poses (N, 3, 4) that the cameras would have if the photos were turned as EXIF says."""
    return np.stack(
        [np.column_stack([as_held(p.camera.c2w[:, :3], p.orientation), p.camera.c2w[:, 3]]) for p in capture.photos]
    )


def _orbit_radius(positions: np.ndarray, center: np.ndarray, otherwise: float) -> float:
    """The median distance of the cameras from the centre; `otherwise` if they stand at the centre."""
    median = float(np.median(np.linalg.norm(positions - center, axis=1)))
    return median if median > 1e-6 * otherwise else otherwise


@dataclass(frozen=True)
class _Layout:
    """Where the content lies, in the input's units.

    center: (3,) the centre of the content.
    unit: the length that becomes 1.
    before: the z-depth of the centre in the cameras.
    near, far: the z-depths of the content.
    """

    center: np.ndarray
    unit: float
    before: float
    near: float
    far: float
    notes: tuple[str, ...] = ()


def _real(capture: Capture, poses: np.ndarray, depths: Depths | None) -> Normalised:
    focus = common_focus(poses)
    layout = _unfocused(poses, depths) if focus is None else _focused(poses, focus, depths)
    notes = layout.notes
    if len(poses) > 1 and spread(poses) == 0:
        notes += (marked("all photos were taken from one place: they tell directions, but no depth"),)
    reach = max(layout.far - layout.before, layout.unit)
    scale = min(1.0, max(LONGEST * layout.unit / reach, 1 / SHRINK)) / layout.unit
    limit = max(layout.before + LONGEST / scale, 2 * layout.near)
    if layout.far > limit * (1 + 1e-9):  # the tolerance is for rounding, if `far` just fits
        notes += (
            phrase(
                "content farther than {limit:.4g} of the input's units (up to {far:.4g}) is drawn there",
                limit=limit,
                far=layout.far,
            ),
        )
    up = up_direction(_held(capture)) if capture.up is None else capture.up / np.linalg.norm(capture.up)
    cameras, to_input = _placed([p.camera for p in capture.photos], upright(up), layout.center, scale)
    return Normalised(
        cameras=cameras,
        near=layout.near * scale,
        far=min(layout.far, limit) * scale,
        ndc=None,
        disparity=True,
        center=np.zeros(3),
        radius=_orbit_radius(poses[:, :, 3], layout.center, layout.unit) * scale,
        up=np.array([0.0, 0.0, 1.0]),
        to_input=to_input,
        notes=notes,
    )


def _focused(poses: np.ndarray, focus: np.ndarray, depths: Depths | None) -> _Layout:
    """The layout for cameras that look at one point, from all around or from one side."""
    offsets = poses[:, :, 3] - focus
    unit = float(np.sqrt((offsets**2).sum(1).mean()))
    z = (offsets * poses[:, :, 2]).sum(1)
    if depths is None:
        near = NO_DEPTHS_NEAR * float(np.percentile(z[z > 0], 5))
        return _Layout(focus, unit, unit, near, (1 + LONGEST) * unit)
    return _Layout(focus, unit, unit, depths.near, depths.far)


def _unfocused(poses: np.ndarray, depths: Depths | None) -> _Layout:
    """The layout for cameras side by side or looking outwards. Depths place the content; without any it is a guess."""
    size = spread(poses)
    forward = -poses[:, :, 2].mean(0)
    length = float(np.linalg.norm(forward))
    reach = depths.middle if depths else NO_DEPTHS_REACH * size or 1.0
    before = reach if length > FORWARD else 0.0
    center = poses[:, :, 3].mean(0) + (before / length * forward if before else 0.0)
    unit = max(reach, size)
    if depths is not None:
        return _Layout(center, unit, before, depths.near, depths.far)
    note = (
        "the cameras do not look at one point and no depths are known: content is assumed around "
        f"{reach:.4g} of the input's units from them; sparse points (COLMAP) or near and far would tell"
    )
    # Who walks ahead passes what the photos show: it is as near as the walk is long, not as far as the content.
    ahead = length > FORWARD and 2 * _along(poses, forward / length) > size
    near = NO_DEPTHS_NEAR * (size if ahead else reach)
    return _Layout(center, unit, before, near, before + LONGEST * unit, (note,))


def _along(poses: np.ndarray, direction: np.ndarray) -> float:
    """The RMS distance of the camera centres from their mean along a unit vector (3,)."""
    return float((poses[:, :, 3] @ direction).std())
