import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.datasets.resample import average_rows, composite, srgb_encoded


@given(rows=st.integers(1, 90), part=st.floats(0, 1), seed=st.integers(0, 99))
def test_rows_are_averaged_by_the_area_that_is_covered(rows: int, part: float, seed: int) -> None:
    count = max(1, round(part * rows))
    image = np.random.default_rng(seed).random((rows, 3, 2)).astype(np.float32)
    fine = np.repeat(image.astype(np.float64), count, axis=0)  # now every output row covers `rows` whole rows
    expected = fine.reshape(count, rows, 3, 2).mean(1)
    np.testing.assert_allclose(average_rows(image, count, lambda v: v), expected, atol=1e-6)


def test_whole_blocks_are_means_and_untouched_photos_are_exact() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    assert np.array_equal(composite(pixels, (8, 6), (0, 0, 0)), pixels.astype(np.uint16) * 257)
    blocks = pixels.reshape(3, 2, 4, 2, 3).mean((1, 3)) * 257
    assert np.abs(composite(pixels, (4, 3), (0, 0, 0)) - blocks).max() <= 0.51
    deep = np.random.default_rng(1).integers(0, 65536, (5, 7, 3), dtype=np.uint16)
    assert np.array_equal(composite(deep, (7, 5), (0, 0, 0)), deep)


def test_invisible_colour_does_not_bleed_into_edges() -> None:
    red, hidden_green = (255, 0, 0, 255), (0, 255, 0, 0)
    pixels = np.array([[red, hidden_green]], dtype=np.uint8)
    on_white = composite(pixels, (1, 1), (1, 1, 1))[0, 0] / 65535
    np.testing.assert_allclose(on_white, (1, 0.5, 0.5), atol=1e-5)
    np.testing.assert_allclose(composite(pixels, (1, 1), (0, 0, 0))[0, 0] / 65535, (0.5, 0, 0), atol=1e-5)


def test_grey_spreads_to_three_channels_with_and_without_alpha() -> None:
    grey = np.array([[[100], [200]]], dtype=np.uint8)
    assert composite(grey, (2, 1), (1, 1, 1)).tolist() == [[[25700] * 3, [51400] * 3]]
    seen_and_not = np.array([[[100, 255], [200, 0]]], dtype=np.uint8)
    assert composite(seen_and_not, (2, 1), (1, 1, 1)).tolist() == [[[25700] * 3, [65535] * 3]]


@pytest.mark.parametrize(
    ("linear", "encoded"), [(0, 0), (0.0031308, 0.04045), (0.18, 0.46135), (1, 1), (7, 1), (-1, 0)]
)
def test_srgb_curve(linear: float, encoded: float) -> None:
    assert srgb_encoded(np.array(linear)) == pytest.approx(encoded, abs=1e-4)
