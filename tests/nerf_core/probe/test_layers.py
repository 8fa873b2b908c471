"""Layers are the peaks of weight over t."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from panel_states import make_ray, make_scene

from nerf_core.probe import PassProbe
from nerf_core.probe.layers import grain_at, pass_layers, weights_in
from nerf_core.probe.radiance import layer_shares

RADIUS, FAR = 1.0, 6.0


def with_weights(t: np.ndarray, weights: np.ndarray, until: np.ndarray | None = None) -> PassProbe:
    transmittance = 1 - np.concatenate([[0], np.cumsum(weights)[:-1]])
    none = np.zeros_like(t)
    rgb = np.stack([t / 10, t / 20, np.full_like(t, 0.5)], -1)
    ends = np.append(t[1:], np.inf) if until is None else until
    return PassProbe("fine", t, ends, ends - t, none, none, transmittance, weights, rgb)


def test_two_peaks_are_two_layers() -> None:
    t = np.linspace(2, 6, 2000, endpoint=False)
    near, far = np.exp(-(((t - 3.0) / 0.02) ** 2)), np.exp(-(((t - 4.5) / 0.05) ** 2))
    weights = 0.3 * near / near.sum() + 0.6 * far / far.sum()
    first, second = pass_layers(with_weights(t, weights), FAR, RADIUS)
    assert (first.weight, second.weight) == (pytest.approx(0.3, abs=0.01), pytest.approx(0.6, abs=0.01))
    assert (first.t, second.t) == (pytest.approx(3.0, abs=0.01), pytest.approx(4.5, abs=0.01))
    # a tenth of a normal distribution exp(−(x/a)²) lies below −0.906 a
    assert first.thickness == pytest.approx(2 * 0.906 * 0.02, abs=0.01)
    assert second.thickness == pytest.approx(2 * 0.906 * 0.05, abs=0.01)
    assert (first.light, second.light) == (pytest.approx(1, abs=0.01), pytest.approx(0.7, abs=0.02))
    assert first.color[0] == pytest.approx(0.3, abs=0.01)


def test_ripples_within_a_surface_are_one_layer() -> None:
    t = np.linspace(2, 6, 2000, endpoint=False)
    weights = np.exp(-(((t - 3.0) / 0.1) ** 2)) * (1 + 0.2 * np.sin(200 * t))
    assert len(pass_layers(with_weights(t, weights / weights.sum()), FAR, RADIUS)) == 1


def test_fog_is_one_thick_layer() -> None:
    t = np.linspace(2, 6, 500, endpoint=False)
    (layer,) = pass_layers(with_weights(t, np.full(500, 0.9 / 500)), FAR, RADIUS)
    assert layer.thickness == pytest.approx(0.8 * 4, rel=0.03)
    assert (layer.begin, layer.end) == (pytest.approx(2, abs=0.05), pytest.approx(6, abs=0.05))


def test_one_sample_and_none() -> None:
    (layer,) = pass_layers(with_weights(np.array([3.0]), np.array([0.7])), FAR, RADIUS)
    assert layer.weight == pytest.approx(0.7)
    assert 3.0 <= layer.t <= 3.0 + 2 * grain_at(3.0, RADIUS)
    assert pass_layers(with_weights(np.zeros(0), np.zeros(0)), FAR, RADIUS) == ()
    assert pass_layers(with_weights(np.array([3.0]), np.array([0.0])), FAR, RADIUS) == ()
    assert pass_layers(with_weights(np.array([3.0]), np.array([np.nan])), FAR, RADIUS) == ()


def test_weights_add_up_whatever_the_samples() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        count = int(rng.integers(1, 300))
        t = np.sort(rng.uniform(0.1, 400, count))
        until = t + rng.uniform(0, 1, count) * np.append(np.diff(t), 5.0)
        weights = rng.random(count) ** 8
        weights *= rng.uniform(0.2, 1) / weights.sum()
        found = pass_layers(with_weights(t, weights, until), 400, 1.5)
        assert sum(layer.weight for layer in found) <= weights.sum() + 1e-6
        for layer in found:
            inside = weights_in(with_weights(t, weights, until), 400, 1.5, layer)
            assert (inside <= weights).all()
            assert inside.sum() == pytest.approx(0.998 * layer.weight)  # a thousandth lies on either side
            assert layer.begin <= layer.t <= layer.end
            assert 0 <= layer.thickness <= layer.end - layer.begin + 1e-9
        assert [layer.t for layer in found] == sorted(layer.t for layer in found)


def test_the_heaviest_layer_is_the_wall() -> None:
    ray = make_ray()
    found = pass_layers(ray.passes[-1], ray.far, RADIUS)
    heaviest = max(found, key=lambda layer: layer.weight)
    assert heaviest.t == pytest.approx(3.8, abs=0.1)
    assert pass_layers(replace(ray.passes[-1], weights=0 * ray.passes[-1].weights), ray.far, RADIUS) == ()


def test_a_sample_that_reaches_out_of_a_layer_counts_by_the_part_within() -> None:
    """A long red sample between two thin blue walls: only its end belongs to the peak of the second wall."""
    t = np.array([1.0, 1.01, 1.02, 3.0, 3.01, 3.02])
    weights = np.array([0.2, 0.1, 0.3, 0.1, 0.2, 0.05])
    p = with_weights(t, weights, np.append(t[1:], 3.03))
    p = replace(p, rgb=np.array([*[[0, 0, 1.0]] * 2, [1.0, 0, 0], *[[0, 0, 1.0]] * 3]))
    first, second = pass_layers(p, FAR, RADIUS)
    for wall in (first, second):
        inside = weights_in(p, FAR, RADIUS, wall)
        assert inside.sum() == pytest.approx(0.998 * wall.weight)
        red = inside[2] / inside.sum()
        np.testing.assert_allclose(wall.color, [red, 0, 1 - red], atol=0.005)
        ray, scene = replace(make_ray(), passes=(p,), far=FAR), replace(make_scene(), radius=RADIUS)
        np.testing.assert_allclose(layer_shares(ray, scene, wall), inside / inside.sum())
    assert weights_in(p, FAR, RADIUS, second)[2] < 0.02  # of 0.3
    np.testing.assert_allclose(weights_in(p, FAR, RADIUS, second)[3:].sum(), 0.35, atol=0.001)
