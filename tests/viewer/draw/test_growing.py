"""The view of a growing model."""

from __future__ import annotations

import numpy as np
import pytest
import textured_photos

from nerf_core.captures.records import Growing
from viewer.draw.growing import _behind, _camera, frame, splats


def model(points: np.ndarray) -> Growing:
    poses = np.stack([camera.c2w for camera in textured_photos.arc()]).astype(np.float32)
    return Growing(poses, points.astype(np.float32), np.full((len(points), 3), 200, np.uint8))


@pytest.mark.parametrize("time", [0.0, 4.0, 12.0])
def test_points_and_cameras_are_seen_upright(time: float) -> None:
    shown = model(np.random.default_rng(0).normal(scale=0.4, size=(500, 3)))
    center, radius, up = frame(shown)
    assert up @ [0, 0, 1] > 0.9
    camera = _camera(center, radius, up, _behind(shown, center), time, (300, 200))
    for points in (shown.points, shown.poses[:, :, 3]):
        pixels, depth = camera.project(points.astype(np.float64))
        assert (depth > 0).all()
        inside = (pixels > 0).all(1) & (pixels < (300, 200)).all(1)
        assert inside.mean() > 0.8
    picture = splats(shown, camera)
    assert picture.shape == (200, 300, 4)
    assert (picture[..., 3] > 0).sum() > 500


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((3, 3))])
def test_a_model_without_extent_is_drawn(points: np.ndarray) -> None:
    shown = model(points)._replace(poses=np.zeros((2, 3, 4), np.float32))
    center, radius, up = frame(shown)
    camera = _camera(center, radius, up, _behind(shown, center), 0.0, (30, 20))
    assert np.isfinite(camera.c2w).all()
    assert splats(shown, camera).shape == (20, 30, 4)
