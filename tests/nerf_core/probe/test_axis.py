"""Which part of a ray its plots show, and where contracted distances lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from panel_states import make_ray, make_scene

from nerf_core.geometry.spaces import contract
from nerf_core.probe import PassProbe, RayProbe
from nerf_core.probe.axis import PLAIN, TAIL, Axis, chosen_axis, contracted_axis, weighty_part


def ray_of(t: np.ndarray, weights: np.ndarray, near: float = 0.1, far: float = 300.0) -> RayProbe:
    """A ray whose last pass has samples at t, each up to the next one."""
    until, zero = np.append(t[1:], far), np.zeros(len(t))
    one = PassProbe("fine", t, until, until - t, zero, zero, zero, weights, np.zeros((len(t), 3)))
    total = np.cumsum(weights)
    median = float(t[np.searchsorted(total, 0.5)]) if total[-1] > 0.5 else None
    mean = float(weights @ t / max(total[-1], 1e-9))
    return replace(
        make_ray(), near=near, far=far, passes=(one,), opacity=float(total[-1]), depth_median=median,
        depth_strongest=float(t[np.argmax(weights)]), depth_expected=mean,
    )  # fmt: skip


def test_the_part_holds_the_weight_and_not_the_expected_depth() -> None:
    t = np.concatenate([np.linspace(0.1, 4, 400), [299.0]])
    weights = np.exp(-(((t - 1.5) / 0.1) ** 2))
    weights *= (1 - TAIL / 2) / weights.sum()
    weights[-1] = TAIL / 2
    ray = ray_of(t, weights)
    low, high = weighty_part(ray, ray.passes, 1.0)
    assert 0.8 < low < 1.3
    assert 1.7 < high < 2.5
    inside = (t >= low) & (t <= high)
    assert weights[inside].sum() > (1 - 2 * TAIL) * weights.sum()
    far = replace(ray, depth_expected=135.0)  # as a little weight at a great distance makes it
    assert weighty_part(far, far.passes, 1.0) == (low, high)
    assert weighty_part(ray, ray.passes, 1.0, 3.5)[1] > 3.5  # a further point to be shown


@pytest.mark.parametrize("weights", [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [np.nan, 0.0, 0.0]])
def test_rays_without_weight_and_with_one_sample_have_an_axis(weights: list[float]) -> None:
    ray = ray_of(np.array([1.0, 2.0, 3.0]), np.nan_to_num(np.array(weights)), far=10.0)
    low, high = weighty_part(ray, ray.passes, 1.0)
    if np.nansum(weights) > 0:
        assert low < 2.0
        assert 3.0 < high < 10.0  # the sample's stretch
    else:
        assert (low, high) == (ray.near, ray.far)
    none = replace(ray, passes=(replace(ray.passes[0], **dict.fromkeys(("t", "until", "weights"), np.zeros(0))),))
    assert weighty_part(none, none.passes, 1.0) == (ray.near, ray.far)


def test_a_contracted_axis_goes_there_and_back_and_ends_at_infinity() -> None:
    axis, t = Axis(2.0), np.geomspace(0.01, 1e6, 1000)
    s = axis.place(t)
    assert (np.diff(s) > 0).all()
    assert (s < 4).all()
    np.testing.assert_allclose(axis.distance(s), t, rtol=1e-6)
    np.testing.assert_array_equal(s[t <= 2], t[t <= 2])
    assert axis.place(np.array(np.inf)) == 4
    assert axis.distance(np.array([4.0, 5.0])).tolist() == [np.inf, np.inf]
    assert PLAIN.place(t) is t
    places, labels = axis.ticks(0.0, 4.0)
    assert labels[-1] == "∞"
    assert (np.diff(places) >= 0.07 * 4).all()
    np.testing.assert_allclose(axis.distance(places[:-1]), [float(label) for label in labels[:-1]])


def test_the_roundest_distances_have_ticks() -> None:
    """Also below 1: 0.1 is as round as 10."""
    assert Axis(0.2).ticks(0.0, 0.4)[1] == ["0", "0.05", "0.1", "0.2", "0.5", "1", "∞"]
    assert Axis(1.0).ticks(0.03, 1.2)[1] == ["0.1", "0.2", "0.5", "1"]
    assert Axis(4.0).ticks(0.0, 8.0)[1] == ["0", "1", "2", "5", "10", "20", "∞"]


def test_contracted_distance_is_the_contraction_of_a_ray_through_the_centre() -> None:
    """From a camera in the middle along an axis, it is that of the space in which grids represent the scene."""
    scene = replace(make_scene(), synthetic=False, ndc=None, center=np.zeros(3), radius=1.5)
    ray = replace(make_ray(), origin=np.zeros(3), direction=np.array([0.0, 1.0, 0.0]))
    axis = contracted_axis(ray, scene)
    assert axis is not None
    assert axis == Axis(1.5)
    t = np.array([0.3, 1.5, 2.0, 10.0, 1e5])
    box = contract(torch.from_numpy(t[:, None] * ray.direction / scene.radius)).norm(dim=-1).numpy()
    np.testing.assert_allclose(axis.place(t), box * scene.radius, rtol=1e-12)
    outside = replace(ray, origin=np.array([0.0, -4.0, 0.0]))  # it leaves the cube at 4 + 1.5
    assert contracted_axis(outside, scene) == Axis(5.5)
    past = replace(ray, origin=np.array([9.0, 0.0, 0.0]))  # it never meets the cube
    assert contracted_axis(past, scene) == Axis(1.5)


def test_auto_contracts_where_the_weight_reaches_far() -> None:
    open_scene = replace(make_scene(), synthetic=False, ndc=None, center=np.full(3, 0.2), radius=1.0)
    ray = ray_of(np.linspace(0.1, 300, 50), np.full(50, 0.01))
    contracted = contracted_axis(ray, open_scene)
    assert contracted is not None
    assert chosen_axis(ray, open_scene, "auto", (0.1, 300.0)) == contracted
    assert chosen_axis(ray, open_scene, "auto", (0.1, 2.0)) == PLAIN
    assert chosen_axis(ray, open_scene, "contracted", (0.1, 2.0)) == contracted
    assert chosen_axis(ray, open_scene, "t", (0.1, 300.0)) == PLAIN
    bounded = replace(open_scene, synthetic=True)
    assert chosen_axis(ray, bounded, "contracted", (0.1, 300.0)) == PLAIN
