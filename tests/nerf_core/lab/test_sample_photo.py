"""The photo that the study draws if none is given."""

from __future__ import annotations

import numpy as np

from nerf_core.lab.sample_noise import fractal, noise, noise_slope
from nerf_core.lab.sample_photo import sample_photo
from nerf_core.lab.sample_terrain import ground
from nerf_core.lab.spectrum import luminance, radial_profile


def test_the_photo_is_the_same_every_time() -> None:
    first = sample_photo(48)
    assert first.shape == (48, 48, 3)
    assert first.dtype == np.float32
    assert np.array_equal(first, sample_photo(48))


def test_a_small_photo_shows_the_same_scene_as_a_large_one() -> None:
    small, large = sample_photo(32), sample_photo(96)
    averaged = large.reshape(32, 3, 32, 3, 3).mean((1, 3))
    assert np.abs(small - averaged).mean() < 0.04
    assert np.abs(small - np.roll(averaged, 3, 1)).mean() > 0.08


def test_the_photo_has_the_statistics_of_natural_ones() -> None:
    """Its range is used, and its power falls about as the square of the frequency (Field 1987)."""
    photo = sample_photo(128)
    assert photo.min() >= 0
    assert photo.max() <= 1
    assert np.quantile(luminance(photo), 0.02) < 0.1
    assert np.quantile(luminance(photo), 0.98) > 0.8
    frequency, power = radial_profile(photo)
    slope = np.polyfit(np.log(frequency[2:]), np.log(power[2:]), 1)[0]
    assert -3.0 < slope < -1.2
    # colours of all kinds: grass and water, red and blue
    spread = photo.max(-1) - photo.min(-1)
    assert np.quantile(spread, 0.9) > 0.3


def test_slopes_are_the_derivatives_of_the_noise() -> None:
    x, y = np.random.default_rng(0).uniform(-9, 9, (2, 500)).astype(np.float64)
    value, along_x, along_y = noise_slope(x, y, 3)
    d = 1e-4
    assert np.array_equal(value, noise(x, y, 3))
    assert np.allclose((noise(x + d, y, 3) - noise(x - d, y, 3)) / (2 * d), along_x, atol=1e-4)
    assert np.allclose((noise(x, y + d, 3) - noise(x, y - d, 3)) / (2 * d), along_y, atol=1e-4)


def test_noise_is_centred_and_other_with_another_salt() -> None:
    x, y = (v.ravel().astype(np.float32) for v in np.meshgrid(np.arange(0, 40, 0.3), np.arange(0, 40, 0.3)))
    value = fractal(x, y, 3, 5)
    assert abs(value.mean()) < 0.03
    assert 0.1 < value.std() < 0.5
    assert abs(np.corrcoef(value, fractal(x, y, 3, 50))[0, 1]) < 0.1


def test_the_land_rises_behind_the_lake() -> None:
    z = np.array([9.2, 15.0], np.float32)
    height = ground(np.full(2, -1.7, np.float32), z, 4)[0]
    assert height[0] < 0
    assert height[1] > 1.5
