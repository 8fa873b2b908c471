"""Spectra of pictures whose frequencies are known."""

from __future__ import annotations

import numpy as np
import pytest

from nerf_core.lab.spectrum import FLOOR, luminance, map_range, radial_profile, spectrum


def wave(height: int, width: int, across: float, down: float, amplitude: float = 0.2) -> np.ndarray:
    """A grey picture of one wave with that many cycles per width and per height."""
    y, x = np.arange(height)[:, None] / height, np.arange(width)[None] / width
    grey = 0.5 + amplitude * np.cos(2 * np.pi * (across * x + down * y))
    return np.repeat(grey[..., None], 3, axis=2)


def test_luminance_weighs_the_channels() -> None:
    assert luminance(np.eye(3)[None]).tolist() == [[0.2126, 0.7152, 0.0722]]
    assert luminance(np.ones((1, 1, 3))).item() == pytest.approx(1.0)


@pytest.mark.parametrize(("across", "down"), [(5, 0), (0, 7), (9, -4)])
def test_a_wave_peaks_at_its_frequency(across: int, down: int) -> None:
    shown = spectrum(wave(32, 48, across, down))
    assert shown.shape == (32, 48)
    peaks = {(int(r) - 16, int(c) - 24) for r, c in np.argwhere(shown > shown.max() - 3)}
    assert peaks == {(down, across), (-down, -across)}
    assert shown.max() == pytest.approx(20 * np.log10(0.1), abs=0.01)  # half of its amplitude 0.2


def test_a_plain_picture_has_no_frequencies() -> None:
    assert np.allclose(spectrum(np.full((8, 8, 3), 0.7)), 20 * np.log10(FLOOR))


def test_opposite_edges_draw_no_cross() -> None:
    """A ramp has a jump between its edges. The window keeps it from spreading over the row of the map."""
    ramp = np.broadcast_to(np.linspace(0, 1, 64)[None, :, None], (64, 64, 3))
    row = spectrum(ramp)[32]
    assert row[32 + 1] > -25
    assert row[32 + 16 :].max() < -80


def test_the_map_range_is_the_targets() -> None:
    shown = spectrum(np.random.default_rng(1).random((64, 64, 3)))
    low, high = map_range(shown)
    assert high == shown.max()
    assert np.mean(shown < low) == pytest.approx(0.005, abs=0.001)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 64), (64, 40)])
def test_the_profile_peaks_at_the_waves_frequency(height: int, width: int) -> None:
    """Frequencies count cycles per longest side, in every direction."""
    side = max(height, width)
    across, down = 12 * width / side, 5 * height / side
    frequency, power = radial_profile(wave(height, width, round(across), round(down)))
    assert frequency.tolist() == list(range(1, side // 2 + 1))
    expected = np.hypot(round(across) * side / width, round(down) * side / height)
    assert abs(frequency[power.argmax()] - expected) <= 1


def test_the_profile_of_white_noise_is_flat_and_holds_its_variance() -> None:
    noise = 0.5 + 0.1 * np.random.default_rng(2).standard_normal((128, 128, 1)).repeat(3, 2)
    _, power = radial_profile(noise)
    assert power.mean() * 128 * 128 == pytest.approx(0.01, rel=0.05)
    assert power[4:].std() < 0.3 * power.mean()
