"""The stages that every method shares: the camera's ray, and the photo that has the true colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balls import Ball, model_of, ring_scene

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene
from nerf_core.probe import open_ray
from nerf_core.probe.walkthrough import truth_of, walk

BALL = Ball((0.0, 0.0, 0.0), 0.7, (0.8, 0.3, 0.2))
BARREL = -0.28  # k1


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(BALL, count=3)


def numbers(text: str) -> np.ndarray:
    return np.array([float(part) for part in text.replace("−", "-").split()])


@pytest.mark.parametrize("k1", [0.0, BARREL])
def test_the_camera_says_which_way_the_pixel_looks(scene: Scene, k1: float) -> None:
    """The last row, rotated into the world, is the ray's direction. With a lens, its distortion is undone."""
    camera = replace(scene.views[0].camera, lens=Lens(k1=k1))
    method = model_of(scene, BALL)
    ray = open_ray(method, scene, camera, (3, 35), 0)
    rows = dict(walk(method, scene, camera, ray)[0].rows)
    assert ("with the lens undone" in rows) == (k1 != 0)
    assert "−1.000" in rows["before the camera"]  # the same minus sign as the window's
    local = numbers(list(rows.values())[-1])
    direction = camera.c2w[:, :3] @ local / np.linalg.norm(local)
    np.testing.assert_allclose(direction, ray.direction, atol=2e-3)  # the row has three decimals


def test_a_photo_has_no_true_colour_where_its_lens_folds(scene: Scene) -> None:
    """A wider camera at the photo's place sees directions at which the photo's lens folds and shows nothing."""
    lens = Camera(40, 30, 30.0, 30.0, 20.0, 15.0, scene.views[0].camera.c2w, Lens(k1=BARREL))
    photo = np.zeros((30, 40, 3), np.uint16)
    views = (replace(scene.views[0], camera=lens), *scene.views[1:])
    scene = replace(scene, views=views, photos=Photos.of([photo, *scene.images[1:]]))
    method = model_of(scene, BALL)
    found = []
    for degrees in (0, 20, 62, 65, 80):
        wide = Camera(1000, 100, 60.0, 60.0, 500.0, 50.0, lens.c2w)
        column = int(500 + 60 * np.tan(np.radians(degrees)))
        found.append(truth_of(scene, wide, open_ray(method, scene, wide, (column, 50), 0)) is not None)
    assert found == [True, True, False, False, False]
