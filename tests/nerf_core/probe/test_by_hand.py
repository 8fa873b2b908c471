"""The formulas of a ray by hand are those of the renderer and of its sampling."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from panel_states import make_ray

from nerf_core.probe import HandRay, hand_cdf, hand_ray_of, hand_terms, resample_by_weights, sampled_at, spread_evenly
from nerf_core.volume.compositing import absorb, composite
from nerf_core.volume.sampling import cumulative, quantiles


def made_up(seed: int, count: int = 10, density: float = 5.0) -> HandRay:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(2, 5, count))
    return HandRay(t, density * rng.exponential(size=count), rng.random((count, 3)), 2.0, 6.0, rng.random(3))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("density", [0.0, 0.5, 500.0])
def test_the_terms_are_those_of_compositing(dtype: torch.dtype, density: float) -> None:
    ray = made_up(0, density=density)
    terms = hand_terms(ray)
    sigma, delta, rgb, background = (
        torch.from_numpy(v).to(dtype) for v in (ray.sigma, terms.delta, ray.rgb, ray.background)
    )
    alpha, transmittance, weights = absorb(sigma[None], delta[None])
    pixel, opacity = composite(weights, rgb[None], background)
    for ours, theirs in (
        (terms.delta, torch.diff(torch.from_numpy(ray.edges))[None]),
        (terms.alpha, alpha), (terms.transmittance, transmittance), (terms.weights, weights), (terms.pixel, pixel),
        (1 - terms.left, opacity), (terms.sums[4], composite(weights[:, :5], rgb[None, :5], 0 * background)[0]),
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs[0].numpy(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("density", [0.0, 0.5, 500.0])
def test_samples_are_placed_as_the_fine_pass_places_them(density: float) -> None:
    ray = made_up(1, density=density)
    edges, weights = (torch.from_numpy(v)[None] for v in (ray.edges, hand_terms(ray).weights))
    np.testing.assert_allclose(hand_cdf(ray), cumulative(weights)[0].numpy(), atol=1e-12)
    middles = torch.tensor([[(k + 0.5) / 33 for k in range(33)]], dtype=torch.float64)
    drawn = resample_by_weights(ray, 33)
    np.testing.assert_allclose(drawn, quantiles(edges, weights, middles)[0].numpy(), atol=1e-6)
    assert ray.t[0] < drawn[0]
    assert drawn[-1] < ray.far  # where a sample would stand for nothing


def test_the_field_between_samples_is_theirs() -> None:
    """Both passes together, as the paper's fine pass, have all of the field's edges: they make the same pixel."""
    ray = made_up(2)
    drawn = resample_by_weights(ray, 17)
    both = sampled_at(ray, np.unique(np.concatenate([ray.t, drawn])))
    np.testing.assert_allclose(hand_terms(both).pixel, hand_terms(ray).pixel, atol=1e-12)
    before = sampled_at(ray, np.array([2.0, ray.t[3]]))
    assert before.sigma.tolist() == [0.0, ray.sigma[3]]
    nothing = HandRay(np.zeros(0), np.zeros(0), np.zeros((0, 3)), 2.0, 6.0, ray.background)
    np.testing.assert_array_equal(hand_terms(sampled_at(nothing, drawn)).pixel, ray.background)


def test_samples_by_the_weights_are_nearer_than_evenly_spaced_ones() -> None:
    """A thin wall in fog: evenly spaced samples miss it."""
    t, sigma = np.array([2.5, 4.53, 4.6]), np.array([0.02, 50.0, 0.0])
    ray = HandRay(t, sigma, np.eye(3), 2.0, 6.0, np.ones(3))
    pixel = hand_terms(ray).pixel
    drawn, even = (
        np.abs(hand_terms(sampled_at(ray, place(ray, 12))).pixel - pixel).max()
        for place in (resample_by_weights, spread_evenly)
    )
    assert drawn < 1 / 12 < even  # a sample's share of the weight


def test_a_few_samples_make_the_pixel_of_an_opened_ray() -> None:
    opened = make_ray()
    ray = hand_ray_of(opened.last, opened.near, opened.far, opened.background, 10)
    assert len(ray.t) == 10
    np.testing.assert_allclose(hand_terms(ray).pixel, opened.color, atol=1e-6)
    part = hand_ray_of(opened.last, 3.5, 4.0, opened.background, 10)
    assert part.t.min() >= 3.5
    assert part.t.max() < 4.0
    assert not len(hand_ray_of(opened.last, 7.0, 8.0, opened.background, 10).t)
