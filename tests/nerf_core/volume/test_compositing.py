"""Compositing against the sums of the paper, written as loops in double precision."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf_core.volume.compositing import EMPTY, absorb, composite, expected_depth


def eq3(sigma: np.ndarray, delta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """NeRF Eq. 3 as it is printed, one ray after another."""
    alpha, transmittance, weights = (np.zeros(sigma.shape) for _ in range(3))
    for ray in range(sigma.shape[0]):
        optical_depth = 0.0
        for i in range(sigma.shape[1]):
            tau = float(sigma[ray, i]) * float(delta[ray, i])
            transmittance[ray, i] = math.exp(-optical_depth)
            alpha[ray, i] = 1 - math.exp(-tau) if tau > 1e-5 else tau
            weights[ray, i] = transmittance[ray, i] * alpha[ray, i]
            optical_depth += tau
    return alpha, transmittance, weights


def random_medium(seed: int, rays: int = 8, samples: int = 24) -> tuple[Tensor, Tensor]:
    """Densities over twelve decades, a third of them zero, and the last δ = 10¹⁰ of the official code."""
    rng = np.random.default_rng(seed)
    sigma = 10 ** rng.uniform(-6, 6, (rays, samples)) * (rng.random((rays, samples)) > 1 / 3)
    delta = 10 ** rng.uniform(-4, 0, (rays, samples))
    delta[:, -1] = 1e10
    return torch.from_numpy(sigma).float(), torch.from_numpy(delta).float()


@given(st.integers(0, 10_000))
def test_weights_are_those_of_equation_3(seed: int) -> None:
    sigma, delta = random_medium(seed)
    got = absorb(sigma, delta)
    for ours, truth in zip(got, eq3(sigma.numpy(), delta.numpy()), strict=True):
        # the relative error of exp(−x) is x·1e-7 for a float32 sum x
        np.testing.assert_allclose(ours.numpy(), truth, rtol=2e-5, atol=1e-6)


@given(st.integers(0, 10_000))
def test_weights_never_sum_to_more_than_one(seed: int) -> None:
    _, _, weights = absorb(*random_medium(seed))
    assert (weights >= 0).all()
    assert weights.sum(-1).max() <= 1 + 1e-6


def test_worked_example() -> None:
    alpha, transmittance, weights = absorb(torch.full((1, 3), 0.1), torch.ones(1, 3))
    torch.testing.assert_close(alpha[0], torch.full((3,), 1 - math.exp(-0.1)))
    torch.testing.assert_close(transmittance[0], torch.tensor([1.0, math.exp(-0.1), math.exp(-0.2)]))
    torch.testing.assert_close(weights[0], torch.tensor([0.09516, 0.08611, 0.07791]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("samples", [1, 7, 192])
def test_a_homogeneous_slab_absorbs_by_beer_and_lambert(samples: int) -> None:
    density, length = 0.7, 3.0
    sigma, delta = torch.full((1, samples), density), torch.full((1, samples), length / samples)
    _, _, weights = absorb(sigma, delta)
    assert float(weights.sum()) == pytest.approx(1 - math.exp(-density * length), rel=1e-6)


def test_color_is_the_weighted_sum_over_the_background() -> None:
    rng = torch.Generator().manual_seed(0)
    weights = torch.rand(5, 9, generator=rng) / 9
    rgb, background = torch.rand(5, 9, 3, generator=rng), torch.tensor([1.0, 0.5, 0.0])
    color, opacity = composite(weights, rgb, background)
    for ray in range(5):
        total = sum(float(w) for w in weights[ray])
        for channel in range(3):
            seen = sum(float(weights[ray, i]) * float(rgb[ray, i, channel]) for i in range(9))
            expected = seen + (1 - total) * float(background[channel])
            assert float(color[ray, channel]) == pytest.approx(expected, abs=1e-6)
        assert float(opacity[ray]) == pytest.approx(total, abs=1e-6)


@given(st.integers(0, 10_000))
def test_gradients_are_finite(seed: int) -> None:
    """Behind opaque samples, in empty space and at the unbounded last step."""
    sigma, delta = random_medium(seed)
    sigma[0, :] = 0
    sigma[1, 3] = 1e12
    sigma.requires_grad_()
    rgb = torch.rand(*sigma.shape, 3, requires_grad=True)
    color, opacity = composite(absorb(sigma, delta)[2], rgb, torch.ones(3))
    (color.square().sum() + opacity.sum()).backward()
    assert sigma.grad is not None
    assert sigma.grad.isfinite().all()
    assert rgb.grad is not None
    assert rgb.grad.isfinite().all()


def test_gradients_agree_with_finite_differences() -> None:
    rng = torch.Generator().manual_seed(1)
    sigma = torch.rand(3, 6, generator=rng, dtype=torch.float64, requires_grad=True)
    rgb = torch.rand(3, 6, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    delta = torch.rand(3, 6, generator=rng, dtype=torch.float64) + 0.1

    def picture(sigma: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
        return composite(absorb(sigma, delta)[2], rgb, torch.ones(3, dtype=torch.float64))

    assert torch.autograd.gradcheck(picture, (sigma, rgb))


def test_expected_depth_is_the_weighted_mean_and_nan_where_nothing_was_hit() -> None:
    t = torch.tensor([[1.0, 2.0, 4.0]]).expand(4, 3)
    weights = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [EMPTY * 0.9, 0.0, 0.0], [0.0, EMPTY * 1.1, 0.0]])
    depth = expected_depth(weights, t)
    assert float(depth[0]) == pytest.approx((0.1 + 0.4 + 1.2) / 0.6)
    assert depth[1:3].isnan().all()
    assert float(depth[3]) == pytest.approx(2.0)


def test_a_faint_haze_still_has_a_depth() -> None:
    """An opacity under half a level of 8 bits is invisible and counts as nothing hit; more than that has a depth."""
    t = torch.tensor([[1.0, 2.0]]).expand(2, 2)
    depth = expected_depth(torch.tensor([[0.5 / 256 * 1.01, 0.0], [0.5 / 256 * 0.99, 0.0]]), t)
    assert float(depth[0]) == pytest.approx(1.0)
    assert depth[1].isnan()
