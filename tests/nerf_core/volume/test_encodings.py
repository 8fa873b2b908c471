"""γ against the formula, term by term."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from nerf_core.volume.encodings import frequency, frequency_width, spherical_harmonics


def gamma(p: list[float], frequencies: int, include_input: bool, pi: bool) -> list[float]:
    """NeRF Eq. 4, with the coordinates of one frequency side by side as in the official code."""
    terms = list(p) if include_input else []
    for k in range(frequencies):
        scale = 2**k * (math.pi if pi else 1)
        terms += [math.sin(scale * x) for x in p] + [math.cos(scale * x) for x in p]
    return terms


@pytest.mark.parametrize("pi", [False, True])
@pytest.mark.parametrize("include_input", [False, True])
@pytest.mark.parametrize("frequencies", [1, 4, 10])
def test_each_term_is_the_formula(frequencies: int, include_input: bool, pi: bool) -> None:
    points = torch.rand(7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4 - 2
    got = frequency(points, frequencies, include_input, pi)
    assert got.shape == (7, frequency_width(frequencies, include_input))
    truth = torch.tensor([gamma(p.tolist(), frequencies, include_input, pi) for p in points], dtype=torch.float64)
    torch.testing.assert_close(got, truth, atol=1e-9, rtol=0)


def test_official_widths() -> None:
    assert frequency_width(10) == 63
    assert frequency_width(4) == 27
    assert frequency_width(10, include_input=False) == 60


@pytest.mark.parametrize("include_input", [False, True])
def test_without_frequencies_the_coordinates_themselves_go_in(include_input: bool) -> None:
    points = torch.rand(5, 3)
    assert torch.equal(frequency(points, 0, include_input), points)
    assert frequency_width(0, include_input) == 3


def test_spherical_harmonics_are_orthonormal() -> None:
    """∫ Y_a Y_b over the sphere is 1 where a = b, else 0: Gauss–Legendre in z, evenly spaced in azimuth, both exact."""
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) / 16 * 2 * np.pi
    z, azimuth = (v.ravel() for v in np.meshgrid(z, azimuth, indexing="ij"))
    side = np.sqrt(1 - z * z)
    d = torch.from_numpy(np.stack([side * np.cos(azimuth), side * np.sin(azimuth), z], -1))
    basis = spherical_harmonics(d)
    area = torch.from_numpy(np.repeat(weight, 16) * 2 * np.pi / 16)
    torch.testing.assert_close((basis * area[:, None]).T @ basis, torch.eye(16, dtype=torch.float64))
