"""Orientations on a turntable: azimuth about the up axis, elevation above its plane, roll about the view direction."""

from __future__ import annotations

import math

import numpy as np

# Closer to the pole than this (the sine of the angle) the direction of view no longer tells an azimuth.
POLE = 1e-6
STEEP = 75.0  # degrees of elevation from which azimuth says little: a step there changes it by four times its angle


def horizontal_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors e1, e2 and up, right-handed. Azimuth 0 points along e1 and grows towards e2."""
    up = up / np.linalg.norm(up)
    e1 = np.eye(3)[np.argmin(np.abs(up))]
    e1 = e1 - (e1 @ up) * up
    e1 /= np.linalg.norm(e1)
    return e1, _cross(up, e1), up


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of two vectors (3,). NumPy's takes four times as long, and a window asks eight times a frame."""
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


def rotation_from(azimuth: float, elevation: float, roll: float, up: np.ndarray) -> np.ndarray:
    """Return the camera-to-world rotation (3, 3), OpenGL axes, of a camera at these angles (radians) around a centre.

    Its z axis points from the centre to the camera: cos(el)(cos(az) e1 + sin(az) e2) + sin(el) up. Without roll its
    x axis is horizontal. At the poles the azimuth alone says how the image is turned.
    """
    e1, e2, up = horizontal_axes(up)
    outwards = math.cos(azimuth) * e1 + math.sin(azimuth) * e2
    back = math.cos(elevation) * outwards + math.sin(elevation) * up
    right = math.cos(azimuth) * e2 - math.sin(azimuth) * e1
    upwards = _cross(back, right)
    c, s = math.cos(roll), math.sin(roll)
    return np.stack([c * right + s * upwards, c * upwards - s * right, back], -1)


def angles_from(rotation: np.ndarray, up: np.ndarray) -> tuple[float, float, float]:
    """Return azimuth, elevation and roll in radians: the inverse of `rotation_from`."""
    e1, e2, up = horizontal_axes(up)
    upwards, back = rotation[:, 1], rotation[:, 2]
    height, flat = back @ up, math.hypot(back @ e1, back @ e2)
    elevation = math.atan2(height, flat)
    # Near the pole the direction of view has no azimuth; the direction of the image's top has it.
    outwards = back if flat > POLE else -np.sign(height) * upwards
    azimuth = math.atan2(outwards @ e2, outwards @ e1)
    upright = rotation_from(azimuth, elevation, 0.0, up)
    x_axis = rotation[:, 0]
    return azimuth, elevation, math.atan2(x_axis @ upright[:, 1], x_axis @ upright[:, 0])


def level(rotation: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the rotation with the same direction of view and no roll."""
    azimuth, elevation, _ = angles_from(rotation, up)
    return rotation_from(azimuth, elevation, 0.0, up)


def looking_along(direction: np.ndarray, rotation: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) without roll that looks along unit `direction`.

    At a pole it keeps the azimuth of `rotation`.
    """
    e1, e2, axis = horizontal_axes(up)
    x, y, z = -direction @ e1, -direction @ e2, -direction @ axis
    flat = math.hypot(x, y)
    azimuth = math.atan2(y, x) if flat > POLE else angles_from(rotation, up)[0]
    return rotation_from(azimuth, math.atan2(z, flat), 0.0, up)
