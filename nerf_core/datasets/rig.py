"""Find what the cameras of a capture have in common: a point that all look at, an up direction."""

from __future__ import annotations

import numpy as np

from nerf_core.geometry.forward_facing import CANCELLED

FOCUS_ROUNDS = 10  # of reweighting; after about five the point moves by less than 1 % of the rig's size
FOCUS_FLOOR = 1e-3  # of the rig's size: bounds the weight 1/distance of an axis that passes closer
FOCUS_SPREAD = 0.01  # the least mean sin² of the axes about their common direction (6°); with less they are parallel
FOCUS_SEEN = 0.75  # share of the cameras that must have the focus in front of them, within 45° of their axis
TURNED = 0.05  # the least share of the image rows' directions beside their main one (13°) that defines a plane
LEVEL = 0.02  # the largest share of them off that plane (8°) for photos that were held level
AGREED = 0.3  # the least cosine between the plane's normal and the mean up vector of the photos
ROLL_ROUNDS = 10  # of choosing each photo's level side; three suffice on most captures
SCATTERED = 0.7  # the longest mean of up vectors of photos held sideways all around; on an arc of 160° it is longer
PARALLEL = 0.9  # the shortest mean of view directions that are nearly one: all within 25° of it reach this


def spread(poses: np.ndarray) -> float:
    """Return the RMS distance of the camera centres of poses (N, 3, 4) from their mean.

    It is exactly 0 if the centres differ only by rounding.
    """
    centers = poses[:, :, 3]
    value = float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))
    return value if value > 1e-9 * np.abs(centers).max() else 0.0


def common_focus(poses: np.ndarray, seen: float = FOCUS_SEEN) -> np.ndarray | None:
    """Return the point (3,) nearest to all optical axes of poses (N, 3, 4).

    It minimises the sum of the distances to the axes (least squares, reweighted by 1/distance), so that a few cameras
    that look elsewhere do not move it. None if the axes do not meet in front of the share `seen` of the cameras.
    """
    size = spread(poses)
    if size == 0:
        return None
    middle = poses[:, :, 3].mean(0)
    centers, forward = (poses[:, :, 3] - middle) / size, -poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # projects onto the plane across the axis
    weights = np.ones(len(poses))
    point, distance = np.zeros(3), np.zeros(len(poses))
    for _ in range(FOCUS_ROUNDS):
        matrix = np.einsum("n,nij->ij", weights, across)
        if np.linalg.eigvalsh(matrix)[0] < FOCUS_SPREAD * weights.sum():
            return None
        point = np.linalg.solve(matrix, np.einsum("n,nij,nj->i", weights, across, centers))
        distance = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centers), axis=1)
        weights = 1 / np.maximum(distance, FOCUS_FLOOR)
    depth = ((point - centers) * forward).sum(1)
    return point * size + middle if (depth > distance).mean() >= seen else None


def as_held(rotation: np.ndarray, orientation: int) -> np.ndarray:
    """Return the camera-to-world rotation (3, 3) of a photo's camera after its EXIF orientation has turned the photo.

    A mirrored photo is turned, but stays mirrored: only its up direction is asked for.
    """
    x, y, back = rotation.T
    right, top = {3: (-x, -y), 4: (-x, -y), 5: (y, -x), 6: (y, -x), 7: (-y, x), 8: (-y, x)}.get(orientation, (x, y))
    return np.stack([right, top, back], -1)


def up_direction(poses: np.ndarray) -> np.ndarray:
    """Return the up direction, a unit vector (3,), from the photos.

    Cameras around an object that look down on it have up vectors that lean towards it, but their image rows stay
    horizontal. If the rows span a plane, up is its normal. Some or all photos may have been taken with a camera on its
    side or upside down; then each has either level rows or level columns. Otherwise up is the mean up vector of the
    photos; if these cancel out although all look one way, as from an aircraft that turns about, it points backwards.
    """
    rows, tops, backs = poses[:, :, 0], poses[:, :, 1], poses[:, :, 2]
    top, back = tops.mean(0), backs.mean(0)
    share, normal = _plane(rows)
    if share[1] > TURNED and share[0] < LEVEL and abs(normal @ top) > AGREED:
        return normal * np.sign(normal @ top)
    if np.linalg.norm(top) < AGREED and np.linalg.norm(back) > PARALLEL:
        return back / np.linalg.norm(back)
    rolled = _rolled_up(poses)
    if rolled is not None:
        return rolled
    if np.linalg.norm(top) < CANCELLED:
        return poses[0, :, 1]
    return top / np.linalg.norm(top)


def _plane(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The plane that unit vectors (N, 3) span: their mean squares along three axes, ascending, and its normal (3,)."""
    share, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    return share, axes[:, 0]


def _rolled_up(poses: np.ndarray) -> np.ndarray | None:
    """The up direction of photos of which each has level rows or level columns; None if there is no such direction.

    The level sides of all photos span a plane. Which side is level is chosen by turns with the plane, from several
    beginnings. Up is the side of the plane to which the photos with level rows point; if there are none, or as many of
    them upside down, that from which the cameras look down.
    """
    sides, tops, back = poses[:, :, :2], poses[:, :, 1], poses[:, :, 2].mean(0)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for vectors in (sides[:, :, 0], sides[:, :, 1], poses[:, :, 2]):
        share, normal = _plane(vectors)
        chosen = np.zeros(len(poses), int)
        for _ in range(ROLL_ROUNDS):
            off = np.abs(np.einsum("nik,i->nk", sides, normal))
            chosen = off.argmin(1)
            share, normal = _plane(np.take_along_axis(sides, chosen[:, None, None], 2)[:, :, 0])
        if share[1] > TURNED and share[0] < LEVEL and (best is None or share[0] < best[0]):
            best = share[0], normal, chosen
    if best is None:
        return None
    _, normal, chosen = best
    # Cameras above each other that face one way look the same as cameras beside each other on their sides.
    if chosen.mean() > 0.5 and np.linalg.norm(tops.mean(0)) > SCATTERED:
        return None
    # Rows of some photos and columns of others span the pictures themselves: the direction of view is not up.
    if np.linalg.norm(tops.mean(0)) > SCATTERED and abs(normal @ tops.mean(0)) < AGREED:
        return None
    vote = float(np.where(chosen == 0, tops @ normal, 0).mean())
    return normal * (np.sign(vote if abs(vote) > AGREED else back @ normal) or 1.0)


def upright(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that takes the unit vector `up` (3,) to +z."""
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    if cosine < -1 + 1e-9:  # upside down: half a turn about any horizontal axis
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)  # Rodrigues, with (1 − cos)/sin² = 1/(1 + cos)
