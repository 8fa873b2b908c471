"""Sample positions against bins, exact inversion of the distribution, and a histogram of many draws."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.volume.sampling import PDF_FLOOR, inverse_transform, spaced, stratified

seeds = st.integers(0, 10_000)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("disparity", [False, True])
def test_spaced_has_its_ends_and_even_steps(disparity: bool) -> None:
    near, far = torch.tensor([2.0, 0.5]), torch.tensor([6.0, 80.0])
    t = spaced(near, far, 64, disparity)
    torch.testing.assert_close(t[:, 0], near)
    torch.testing.assert_close(t[:, -1], far)
    steps = (1 / t if disparity else t).diff(dim=-1)
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps), rtol=2e-2, atol=1e-6)
    assert (t.diff(dim=-1) > 0).all()


def test_stratified_fills_every_bin_and_never_leaves_it() -> None:
    t = spaced(torch.full((4000,), 2.0), torch.full((4000,), 6.0), 8, disparity=False)
    drawn = stratified(t, generator())
    middle = (t[0, 1:] + t[0, :-1]) / 2
    lower, upper = torch.cat([t[0, :1], middle]), torch.cat([middle, t[0, -1:]])
    assert ((drawn >= lower) & (drawn <= upper)).all()
    share = (drawn - lower) / (upper - lower)
    assert share.min() < 0.01
    assert share.max() > 0.99
    # a uniform share has mean 1/2 and standard error 1/√(12·4000) = 0.0046
    torch.testing.assert_close(share.mean(0), torch.full((8,), 0.5), atol=0.023, rtol=0)


def test_stratified_keeps_the_order_of_uneven_depths() -> None:
    t = spaced(torch.full((500,), 0.1), torch.full((500,), 90.0), 32, disparity=True)
    assert (stratified(t, generator(3)).diff(dim=-1) >= 0).all()


def random_density(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Edges (4, 13) and weights (4, 12) of double precision; half of the bins are empty."""
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.uniform(-2, 5, (4, 13)), -1)
    weights = rng.random((4, 12)) * (rng.random((4, 12)) > 0.5) / 12
    return torch.from_numpy(edges), torch.from_numpy(weights)


@given(seeds)
def test_quantiles_invert_the_distribution_exactly(seed: int) -> None:
    edges, weights = random_density(seed)
    got = inverse_transform(edges, weights, 50, None)
    assert (got.diff(dim=-1) >= -1e-12).all()
    for ray in range(4):
        mass = weights[ray].numpy() + PDF_FLOOR
        cdf = np.concatenate([[0], mass.cumsum()]) / mass.sum()
        truth = np.interp(np.linspace(0, 1, 50), cdf, edges[ray].numpy())
        np.testing.assert_allclose(got[ray].numpy(), truth, atol=1e-8)


@given(seeds)
def test_draws_of_single_precision_stay_inside(seed: int) -> None:
    edges, weights = (v.float() for v in random_density(seed))
    for source in (None, generator(seed)):
        got = inverse_transform(edges, weights, 64, source)
        assert got.isfinite().all()
        assert ((got >= edges[:, :1]) & (got <= edges[:, -1:])).all()


def test_a_histogram_of_draws_is_the_density() -> None:
    edges = torch.tensor([[0.0, 0.1, 0.5, 0.6, 2.0]])
    weights = torch.tensor([[0.1, 0.0, 0.3, 0.2]])
    count = 100_000
    drawn = inverse_transform(edges, weights, count, generator(5))[0]
    found = torch.histogram(drawn, edges[0]).hist / count
    expected = (weights[0] + PDF_FLOOR) / (weights[0] + PDF_FLOOR).sum()
    spread = (expected * (1 - expected) / count).sqrt()
    assert ((found - expected).abs() <= 4 * spread + 1 / count).all()
    # within a bin the density is constant
    inside = drawn[drawn > 0.6]
    halves = torch.histogram(inside, torch.tensor([0.6, 1.3, 2.0])).hist / len(inside)
    assert float(halves[0]) == pytest.approx(0.5, abs=0.02)


def test_a_ray_that_hits_nothing_is_sampled_evenly_over_its_bins() -> None:
    edges = torch.tensor([[1.0, 2.0, 3.0, 5.0]])
    got = inverse_transform(edges, torch.zeros(1, 3), 4, None)
    torch.testing.assert_close(got, edges, atol=1e-5, rtol=0)


def test_one_heavy_bin_attracts_all_but_the_floor() -> None:
    edges = torch.linspace(0, 1, 64)[None]
    weights = torch.zeros(1, 63)
    weights[0, 40] = 1
    inner = inverse_transform(edges, weights, 128, None)[0, 1:-1]
    assert ((inner >= edges[0, 40] - 1e-6) & (inner <= edges[0, 41] + 1e-6)).all()
