"""What a rig of cameras has in common: a mean camera, a point that all look at, which way is up."""

from __future__ import annotations

import numpy as np

CANCELLED = 1e-3  # a mean of unit vectors this short has no direction: they point all ways, or against each other
FOCUS_ROUNDS = 10  # of reweighting; the point moves by less than 1 % of the rig's size after some five
FOCUS_FLOOR = 1e-3  # of the rig's size: an axis that passes this close has its full weight, not an infinite one
FOCUS_SPREAD = 0.01  # least mean sin² of the axes about their common direction (6°): below, they are parallel
FOCUS_SEEN = 0.75  # share of the cameras that must have the focus before them, within 45° of their axis
TURNED = 0.05  # least share of the image rows' directions off their main one (13°) for a plane to be told
LEVEL = 0.02  # largest share of them off that plane (8°) for the photos to count as held level
AGREED = 0.3  # least cosine between the plane's normal and the mean top of the photos


def mean_camera(poses: np.ndarray) -> np.ndarray | None:
    """poses (N, 3, 4) → the mean camera (3, 4), None where the views or tops cancel out.

    Position and back are the means; x = up × back, y = back × x of the mean up (official LLFF `poses_avg`).
    """
    up, back, position = poses[:, :, 1:].mean(0).T
    right = np.cross(up, back)
    if min(np.linalg.norm(back), np.linalg.norm(right)) < CANCELLED:
        return None
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])


def spread(poses: np.ndarray) -> float:
    """RMS distance of the camera centres (N, 3, 4) from their mean; exactly 0 where only rounding tells them apart."""
    centers = poses[:, :, 3]
    value = float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))
    return value if value > 1e-9 * np.abs(centers).max() else 0.0


def common_focus(poses: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all optical axes of poses (N, 3, 4); None where they do not meet before the cameras.

    It minimises the sum of its distances to the axes (least squares, reweighted by 1/distance), so that a few
    cameras that look elsewhere do not move it.
    """
    size = spread(poses)
    if size == 0:
        return None
    middle = poses[:, :, 3].mean(0)
    centers, forward = (poses[:, :, 3] - middle) / size, -poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # takes off what lies along the axis
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
    return point * size + middle if (depth > distance).mean() >= FOCUS_SEEN else None


def up_direction(poses: np.ndarray) -> np.ndarray:
    """Which way is up, (3,) unit: the photos' common top.

    Cameras that walk around something and look down on it have tops that lean to its side. Their image rows stay
    horizontal: where these span a plane, up is its normal.
    """
    rows, top = poses[:, :, 0], poses[:, :, 1].mean(0)
    share, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    normal = axes[:, 0]
    if share[1] > TURNED and share[0] < LEVEL and abs(normal @ top) > AGREED:
        return normal * np.sign(normal @ top)
    if np.linalg.norm(top) < CANCELLED:
        return poses[0, :, 1]
    return top / np.linalg.norm(top)


def upright(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that takes unit `up` (3,) to +z: the input's axes turn as little as they can."""
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    if cosine < -1 + 1e-9:  # upside down: every horizontal axis turns it by the least angle
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)  # Rodrigues, with (1 − cos)/sin² = 1/(1 + cos)
