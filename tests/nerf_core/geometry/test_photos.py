"""Photos in one array."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nerf_core.geometry.fast_rays import photo_colors
from nerf_core.geometry.photos import Photos


def test_images_are_views_of_the_one_array() -> None:
    images = [np.full((2, 3, 3), 7, np.uint16), np.arange(12, dtype=np.uint16).reshape(4, 1, 3)]
    photos = Photos.of(images)
    assert photos.flat.shape == (10, 3)
    assert photos.starts.tolist() == [0, 6]
    assert photos.sizes.tolist() == [[3, 2], [1, 4]]
    for image, given in zip(photos.images, images, strict=True):
        np.testing.assert_array_equal(image, given)
        assert np.shares_memory(image, photos.flat)
    assert photos.images[0] is photos.images[0]


def test_chosen_photos_are_not_copied() -> None:
    photos = Photos.of([np.full((2, 3, 3), k, np.uint16) for k in range(4)])
    chosen = photos.at([3, 1])
    assert chosen.flat is photos.flat
    assert [int(image[0, 0, 0]) for image in chosen.images] == [3, 1]


def test_eight_bits_read_as_sixteen() -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (*size, 3)).astype(np.uint16) * 257 for size in ((5, 4), (3, 7))]
    wide, narrow = Photos.of(images), Photos.empty([(4, 5), (7, 3)], eight_bits=True)
    for k, image in enumerate(images):
        narrow.put(k, image)
    assert 2 * narrow.flat.nbytes == wide.flat.nbytes
    assert [image.dtype for image in narrow.images] == [np.uint16] * 2
    for a, b in zip(narrow.images, wide.images, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(narrow.part(1, slice(1, None), [6, 0]), images[1][1:, [6, 0]])
    np.testing.assert_array_equal(narrow.at([1]).images[0], images[1])
    np.testing.assert_array_equal(narrow.small(1, 4), wide.small(1, 4))


def test_eight_bits_are_the_same_colours_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.arange(256, dtype=np.uint8)[:, None].repeat(3, 1)
    index = torch.zeros(256, dtype=torch.long)
    pixel = torch.stack([torch.arange(256), index], -1)
    for _ in range(2):
        narrow = photo_colors(index, pixel, index + 256, index, values)
        assert torch.equal(narrow, photo_colors(index, pixel, index + 256, index, values.astype(np.uint16) * 257))
        monkeypatch.setattr("nerf_core.geometry.fast_rays.numba_obstacle", lambda: "numba is gone")


def test_there_may_be_no_photos() -> None:
    assert Photos.of([]).images == ()
    assert Photos.empty([(5, 4)]).at([]).images == ()
