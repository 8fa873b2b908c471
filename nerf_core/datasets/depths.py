"""Find the nearest and farthest depth of a capture's content from bounds or sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerf_core.datasets.capture import Capture, Depths
from nerf_core.geometry.camera import Camera

MARGIN = 0.9  # official LLFF: samples begin at 0.9 of the nearest bound; the farthest percentile gets the same margin
PERCENTILES = (0.5, 50.0, 99.5)  # a sparse model has outliers on both sides
NEAREST = 1e-3  # of the median depth: nearer points would touch a lens, so they are outliers, however many there are
MAX_PAIRS = 20_000_000  # of points and cameras: more of them take seconds and do not change a percentile


def known_depths(capture: Capture) -> Depths | None:
    """Return the depths in the input's units; None for a capture without bounds, without depth maps, and without points
    that cameras see."""
    if capture.near is not None and capture.far is not None:
        return Depths(capture.near, capture.near, _middle(capture.near, capture.far), capture.far)
    if capture.bounds_per_photo is not None:
        closest, far = float(capture.bounds_per_photo.min()), float(capture.bounds_per_photo.max())
        return Depths(closest, MARGIN * closest, _middle(closest, far), far)
    if capture.depths is not None:
        return capture.depths
    if capture.points is None:
        return None
    z = seen_depths([photo.camera for photo in capture.photos], capture.points)
    if not len(z):
        return None
    return robust_depths(z, z)


def robust_depths(z: np.ndarray, all_z: np.ndarray) -> Depths:
    """Return the depths of a capture from those of pixels or points, some of which are wrong.

    z: (K,) z-depths. all_z: (L,) these and less certain ones, which tell no more than how far content may reach.
    """
    closest, middle, _ = (float(v) for v in np.percentile(z, PERCENTILES))
    far = float(np.percentile(all_z, PERCENTILES[-1]))
    closest = max(closest, NEAREST * middle)
    return Depths(closest, MARGIN * closest, middle, max(far, middle) / MARGIN)


def seen_depths(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return, in one array, the z-depths of world points (P, 3) in all cameras whose pictures show them."""
    chosen = points[:: 1 + len(points) * len(cameras) // MAX_PAIRS]
    found = []
    for camera in cameras:
        (column, row), z = (v.T for v in camera.project(chosen))
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        found.append(z[inside])
    return np.concatenate(found)


def _middle(near: float, far: float) -> float:
    """The depth half way in disparity, because samples of real captures are spaced in disparity."""
    return 2 / (1 / near + 1 / far)
