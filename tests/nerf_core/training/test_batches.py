"""Which pixels are drawn, and whether their rays and colours belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene
from nerf_core.training.batches import Draw, PixelSampler, shuffled

CPU = torch.device("cpu")


def coded(scene: Scene) -> Scene:
    """The scene with photos of two sizes whose pixels encode their place: (view, column, row) · 100."""
    views, images = [], []
    for i, view in enumerate(scene.views):
        width, height = (16, 16) if i % 2 else (10, 24)
        rows, columns = np.mgrid[:height, :width]
        images.append((np.stack([np.full_like(rows, i), columns, rows], -1) * 100).astype(np.uint16))
        views.append(replace(view, camera=view.camera.resized(width, height)))
    return replace(scene, views=tuple(views), photos=Photos.of(images))


def decoded(truth: torch.Tensor) -> np.ndarray:
    return np.rint(truth.numpy() * 655.35).astype(int)


@pytest.mark.parametrize("one_image", [True, False])
def test_a_ray_goes_through_the_pixel_whose_colour_it_gets(scene: Scene, one_image: bool) -> None:
    scene = coded(scene)
    sampler = PixelSampler(scene, 0, CPU, seed=1)
    for _ in range(5):
        rays, truth = sampler.draw(Draw(200, one_image))
        meant = decoded(truth)
        assert (len(set(meant[:, 0])) == 1) is one_image
        assert set(meant[:, 0]) <= {0, 1, 2, 3, 4}  # none of the held-out view
        points = (rays.origins + rays.near[:, None] * rays.directions).double().numpy()
        for view, column, row, point in zip(*meant.T, points, strict=True):
            where, _ = scene.views[view].camera.project(point[None])
            np.testing.assert_allclose(where[0], [column + 0.5, row + 0.5], atol=1e-3)


PIXELS = [240, 256, 240, 256, 240]  # of the training photos of `coded`


def test_every_pixel_is_drawn_once_before_any_is_drawn_again(scene: Scene) -> None:
    """Of pixels drawn with replacement, 1/e = 37 % would be left out."""
    sampler = PixelSampler(coded(scene), 0, CPU, seed=0)
    orders = []
    for _ in range(2):
        drawn = [decoded(sampler.draw(Draw(count))[1]) for count in (1, 231, 500, 500)]
        orders.append(np.concatenate(drawn))
        assert len(orders[-1]) == sum(PIXELS)
        assert len(np.unique(orders[-1], axis=0)) == sum(PIXELS)
    assert (orders[0] == orders[1]).all(1).mean() < 0.02  # the second time in another order


def test_a_step_is_a_random_choice_of_pixels(scene: Scene) -> None:
    """In many steps, each half of each photo has its share, and as much chance: 9 of 88 pixels, σ = 2.7."""
    scene = coded(scene)
    sampler = PixelSampler(scene, 0, CPU, seed=0)
    drawn = np.array([decoded(sampler.draw(Draw(88))[1]) for _ in range(2000)])
    for k, count in enumerate(PIXELS):
        height, width = scene.images[k].shape[:2]
        mine = drawn[..., 0] == k
        for half in (mine & (drawn[..., 1] < width // 2), mine & (drawn[..., 2] < height // 2)):
            each = half.sum(1)
            expected = 88 * count / 2 / sum(PIXELS)
            assert each.mean() == pytest.approx(expected, abs=0.05)
            assert each.std() == pytest.approx(
                np.sqrt(expected * (1 - expected / 88) * (1 - 88 / sum(PIXELS))), rel=0.1
            )


@pytest.mark.parametrize("bits", [1, 2, 3, 10, 13])
def test_an_order_has_every_number_once(bits: int) -> None:
    for key in (0, 1, 2**63 - 1):
        for turn in (0, 1, 2**40):
            places = np.arange(turn << bits, (turn + 1) << bits, dtype=np.uint64)
            assert np.sort(shuffled(places, key, bits)).tolist() == list(range(1 << bits))


def test_the_last_pixels_of_a_very_wide_photo_are_drawn(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers of 32 bits could not tell them apart."""
    width = 2**24
    view = replace(scene.views[0], camera=scene.views[0].camera.resized(width, 1))
    wide = replace(scene, views=(view,), photos=Photos.of([np.zeros((1, width, 3), np.uint8)]), splits={"train": (0,)})
    sampler = PixelSampler(wide, 0, CPU, 0)
    last = torch.arange(width - 100, width)
    monkeypatch.setattr(sampler, "_next", lambda *_: last)
    assert torch.equal(sampler._pixels(sampler._at(1), Draw(100))[1][:, 0], last)


def test_a_state_at_the_end_goes_on(scene: Scene) -> None:
    sampler = PixelSampler(scene, 0, CPU, 0)
    sampler.load_state(sampler.state() | {"order": torch.tensor([2**63 - 1, 2**62])})
    for _ in range(3):
        sampler.draw(Draw(500))
        assert sampler.state()["order"][1] > 2**62


def test_photos_that_change_their_size_go_on(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), 0, CPU, seed=0)
    for shrink in (4, 2, 1):
        assert len(sampler.draw(Draw(3000, shrink=shrink))[1]) == 3000


def test_a_crop_is_the_middle_of_each_photo(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), 0, CPU, 0)
    for crop, (low, high) in {0.5: (4, 11), 1.0: (0, 15)}.items():
        meant = decoded(sampler.draw(Draw(4000, crop=crop))[1])
        square = meant[meant[:, 0] % 2 == 1]  # the photos of 16 × 16 pixels
        assert square[:, 1:].min() == low
        assert square[:, 1:].max() == high


def test_shrunken_photos_are_block_means_and_their_rays_go_through_the_blocks_middle(scene: Scene) -> None:
    scene = coded(scene)
    rays, truth = PixelSampler(scene, 0, CPU, 0).draw(Draw(300, shrink=4))
    points = (rays.origins + rays.near[:, None] * rays.directions).double().numpy()
    for color, point in zip(truth.numpy() * 655.35, points, strict=True):
        where, _ = scene.views[round(color[0])].camera.project(point[None])
        # a mean of four columns c … c + 3 is c + 1.5, and the block's middle lies at c + 2
        np.testing.assert_allclose(where[0] - color[1:], [0.5, 0.5], atol=1e-2)


def test_fewer_images_are_spread_evenly(scene: Scene) -> None:
    sampler = PixelSampler(coded(scene), 3, CPU, seed=0)
    assert set(decoded(sampler.draw(Draw(500))[1])[:, 0]) == {0, 2, 4}


def test_the_same_state_draws_the_same_rays(scene: Scene) -> None:
    a, b = (PixelSampler(scene, 0, CPU, seed) for seed in (0, 1))
    assert not torch.equal(a.draw(Draw(9))[0].directions, b.draw(Draw(9))[0].directions)
    b.load_state(a.state())
    assert torch.equal(a.draw(Draw(9, True))[0].directions, b.draw(Draw(9, True))[0].directions)


def test_a_state_of_an_earlier_version_decides_what_is_drawn(scene: Scene) -> None:
    found = []
    for seed in (0, 1):
        sampler = PixelSampler(scene, 0, CPU, seed)
        sampler.draw(Draw(seed + 5))
        sampler.load_state({"generator": torch.Generator().manual_seed(5).get_state()})
        found.append(sampler.draw(Draw(9))[0].directions)
    assert torch.equal(*found)


@pytest.mark.parametrize(
    "order", [torch.zeros(3, dtype=torch.int64), torch.zeros(2), torch.tensor([1, -1]), torch.tensor([1, 2**63 - 1])]
)
def test_an_order_that_is_none_is_refused(scene: Scene, order: torch.Tensor) -> None:
    sampler = PixelSampler(scene, 0, CPU, 0)
    with pytest.raises(ValueError, match="two numbers of 0 or more"):
        sampler.load_state(sampler.state() | {"order": order})


def test_a_scene_without_training_photos_is_refused(scene: Scene) -> None:
    with pytest.raises(UserError, match="ball: no training photos: every photo is held out"):
        PixelSampler(replace(scene, splits={"test": (0, 1)}), 0, CPU, 0)


def masked(scene: Scene, masks: dict[int, np.ndarray]) -> Scene:
    return replace(scene, photos=scene.photos.masked(masks))


@pytest.mark.parametrize("wanted", [Draw(3000), Draw(3000, True), Draw(3000, crop=0.5)])
def test_masked_pixels_are_not_drawn(scene: Scene, wanted: Draw) -> None:
    scene = coded(scene)
    left, hardly = np.zeros((16, 16), bool), np.zeros((24, 10), bool)
    left[:, :8], hardly[11, 4] = True, True
    scene = masked(scene, {1: left, 2: hardly, 4: np.zeros((24, 10), bool)})
    sampler, found = PixelSampler(scene, 0, CPU, 0), np.zeros((0, 3), int)
    for _ in range(12):
        truth = sampler.draw(wanted)[1]
        assert len(truth) == 3000
        found = np.concatenate([found, decoded(truth)])
    assert set(found[:, 0]) == {0, 1, 2, 3}
    assert (found[found[:, 0] == 1, 1] < 8).all()
    assert np.unique(found[found[:, 0] == 2, 1:], axis=0).tolist() == [[4, 11]]
    if wanted.crop == 1 and not wanted.one_image:
        share = (found[:, 0] == 1).mean()
        assert share == pytest.approx(128 / (128 + 1 + 240 + 256), abs=0.01)


def test_a_crop_that_is_masked_falls_back_to_whole_photos(scene: Scene) -> None:
    scene = coded(scene)
    masks = {i: np.zeros((16, 16) if i % 2 else (24, 10), bool) for i in range(6)}
    for mask in masks.values():
        mask[0] = True
    truth = PixelSampler(masked(scene, masks), 0, CPU, 0).draw(Draw(500, crop=0.5))[1]
    assert set(decoded(truth)[:, 2]) == {0}


def test_shrunken_photos_average_the_pixels_that_are_not_masked(scene: Scene) -> None:
    scene = coded(scene)
    mask = np.ones((16, 16), bool)
    mask[:, 5:8] = False  # of the second block of four columns only the first counts, less than half
    mask[:, 8] = False  # of the third all but the first
    scene = masked(replace(scene, splits={"train": (1,)}), {1: mask})
    truth = PixelSampler(scene, 0, CPU, 0).draw(Draw(400, shrink=4))[1].numpy() * 655.35
    assert np.unique(truth[:, 1].round(2)).tolist() == pytest.approx([1.5, 10, 13.5], abs=0.01)


def test_without_masks_the_same_pixels_are_drawn_as_with_masks_that_leave_all(scene: Scene) -> None:
    plain, whole = coded(scene), masked(coded(scene), {0: np.ones((24, 10), bool)})
    a, b = (PixelSampler(one, 0, CPU, 7).draw(Draw(50))[0] for one in (plain, whole))
    assert torch.equal(a.directions, b.directions)
