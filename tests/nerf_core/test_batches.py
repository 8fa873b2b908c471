"""Which pixels are drawn, and whether their rays and colours belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_core.batches import PixelSampler
from nerf_core.errors import UserError
from nerf_core.nerf_config import NerfConfig
from nerf_core.scene import Scene

CPU = torch.device("cpu")


def coded(scene: Scene) -> Scene:
    """The scene with photos of two sizes whose pixels say where they are: (view, column, row) · 100."""
    views, images = [], []
    for i, view in enumerate(scene.views):
        width, height = (16, 16) if i % 2 else (10, 24)
        rows, columns = np.mgrid[:height, :width]
        images.append((np.stack([np.full_like(rows, i), columns, rows], -1) * 100).astype(np.uint16))
        views.append(replace(view, camera=view.camera.resized(width, height)))
    return replace(scene, views=tuple(views), images=tuple(images))


def decoded(truth: torch.Tensor) -> np.ndarray:
    return np.rint(truth.numpy() * 655.35).astype(int)


@pytest.mark.parametrize("one_image", [True, False])
def test_a_ray_goes_through_the_pixel_whose_colour_it_gets(scene: Scene, one_image: bool) -> None:
    scene = coded(scene)
    sampler = PixelSampler(scene, NerfConfig(rays=200, one_image=one_image), CPU, seed=1)
    for step in range(5):
        rays, truth = sampler.draw(step)
        meant = decoded(truth)
        assert (len(set(meant[:, 0])) == 1) is one_image
        assert set(meant[:, 0]) <= {0, 1, 2, 3, 4}  # none of the held-out view
        points = (rays.origins + rays.near[:, None] * rays.directions).double().numpy()
        for view, column, row, point in zip(*meant.T, points, strict=True):
            where, _ = scene.views[view].camera.project(point[None])
            np.testing.assert_allclose(where[0], [column + 0.5, row + 0.5], atol=1e-3)


def test_every_pixel_is_drawn_alike(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), NerfConfig(rays=50_000, one_image=False), CPU, seed=0)
    counts = {v: (16 * 16 if v % 2 else 10 * 24) for v in range(5)}
    found = np.bincount(decoded(sampler.draw(0)[1])[:, 0], minlength=5)
    expected = np.array([counts[v] for v in range(5)]) / sum(counts.values()) * 50_000
    np.testing.assert_allclose(found, expected, atol=4 * np.sqrt(expected.max()))


def test_the_centre_crop_ends_when_it_should(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), NerfConfig(rays=4000, one_image=False, precrop_steps=3, precrop=0.5), CPU, 0)
    for step, (low, high) in {0: (4, 11), 2: (4, 11), 3: (0, 15)}.items():
        meant = decoded(sampler.draw(step)[1])
        square = meant[meant[:, 0] % 2 == 1]  # the photos of 16 × 16 pixels
        assert square[:, 1:].min() == low
        assert square[:, 1:].max() == high


def test_fewer_images_are_spread_evenly(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), NerfConfig(rays=500, one_image=False, train_images=3), CPU, seed=0)
    assert set(decoded(sampler.draw(0)[1])[:, 0]) == {0, 2, 4}


def test_the_same_state_draws_the_same_rays(scene: Scene) -> None:
    a, b = (PixelSampler(scene, NerfConfig(rays=9), CPU, seed) for seed in (0, 1))
    assert not torch.equal(a.draw(0)[0].directions, b.draw(0)[0].directions)
    b.load_state(a.state())
    assert torch.equal(a.draw(1)[0].directions, b.draw(1)[0].directions)


def test_a_scene_without_training_photos_is_refused(scene: Scene) -> None:
    with pytest.raises(UserError, match="ball: no training photos: every photo is held out"):
        PixelSampler(replace(scene, splits={"test": (0, 1)}), NerfConfig(), CPU, 0)
