"""Photos in one array."""

from __future__ import annotations

import numpy as np

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


def test_there_may_be_no_photos() -> None:
    assert Photos.of([]).images == ()
    assert Photos.empty([(5, 4)]).at([]).images == ()
