"""Compare the step curves that a ray's plots draw with the ray's samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import panel_states

from nerf_core.probe import PassProbe, RayProbe
from viewer.draw.ray_steps import Steps, steps_of


def ray_of(t: list[float], until: list[float], tau: list[float], near: float, far: float) -> RayProbe:
    begins, ends, depth = np.array(t), np.array(until), np.array(tau)
    alpha, transmittance = 1 - np.exp(-depth), np.exp(-np.append(0, depth.cumsum()[:-1]))
    delta = ends - begins
    one = PassProbe(
        "voxels", begins, ends, delta, depth / delta, alpha, transmittance, alpha * transmittance,
        np.tile([0.2, 0.4, 0.6], (len(t), 1)),
    )  # fmt: skip
    return replace(panel_states.make_ray(), passes=(one,), near=near, far=far)


def at(steps: Steps, values: np.ndarray, t: float) -> float:
    return float(values[np.searchsorted(steps.edges, t, side="right") - 1])


def test_weight_and_density_are_0_between_samples() -> None:
    ray = ray_of([2.0, 2.5, 4.0], [2.5, 3.0, 4.5], [0.5, 0.7, 2.0], near=1.0, far=6.0)
    (steps,) = steps_of(ray)
    assert steps.edges.tolist() == [1.0, 2.0, 2.5, 3.0, 4.0, 4.5, 6.0]
    for t, sample in ((1.5, None), (2.2, 0), (2.7, 1), (3.5, None), (4.2, 2), (5.0, None)):
        weight = 0.0 if sample is None else ray.passes[0].weights[sample]
        sigma = 0.0 if sample is None else ray.passes[0].sigma[sample]
        assert at(steps, steps.weights, t) == weight
        assert at(steps, steps.sigma, t) == sigma
    assert steps.t.tolist() == [2.0, 2.5, 4.0]
    assert steps.until.tolist() == [2.5, 3.0, 4.5]


def test_transmittance_starts_at_1_and_falls_only_along_samples() -> None:
    (steps,) = steps_of(ray_of([2.0, 2.5, 4.0], [2.5, 3.0, 4.5], [0.5, 0.7, 2.0], near=1.0, far=6.0))
    found = np.interp([1.0, 1.9, 2.0, 2.5, 3.0, 3.9, 4.5, 6.0], steps.edges, steps.transmittance)
    np.testing.assert_allclose(found, np.exp([0, 0, 0, -0.5, -1.2, -1.2, -3.2, -3.2]))


def test_samples_that_touch_have_no_gap_between_them_and_the_last_ends_at_far() -> None:
    ray = ray_of([1.0, 2.0, 3.0], [2.0 - 1e-7, 3.0 + 1e-7, 1e10], [0.1, 0.1, 0.1], near=1.0, far=6.0)
    (steps,) = steps_of(ray)
    assert steps.edges.tolist() == [1.0, 2.0, 3.0, 6.0]
    assert steps.until.tolist() == [2.0 - 1e-7, 3.0, 6.0]


def test_a_gap_of_a_tenth_of_a_sample_is_a_gap() -> None:
    (steps,) = steps_of(ray_of([1.0, 2.0], [1.9, 3.0], [0.1, 0.1], near=1.0, far=3.0))
    assert steps.edges.tolist() == [1.0, 1.9, 2.0, 3.0]
    assert at(steps, steps.weights, 1.95) == 0


def test_a_last_sample_past_the_far_end_still_has_a_length() -> None:
    (steps,) = steps_of(ray_of([1.0, 9.0], [9.0, 1e10], [0.1, 0.1], near=1.0, far=3.0))
    assert steps.until.tolist() == [9.0, 11.0]
