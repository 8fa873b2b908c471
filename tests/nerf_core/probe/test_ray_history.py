"""The history of a pinned ray: which steps are recorded, and what a record holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from panel_states import bare_ray, make_ray

from nerf_core.probe.history import BINS, HistoryRecorder, binned


def recorded(first: int, last: int, until: int) -> list[int]:
    """The steps of the records of a training from step `first` to `until`, whose schedule ends at `last`."""
    recorder, ray = HistoryRecorder(first, last), make_ray(step=0)
    for step in range(first, until + 1):
        if recorder.due(step):
            recorder.add(replace(ray, step=step))
    history = recorder.view()
    assert history is not None
    return history.steps.tolist()


@pytest.mark.parametrize("last", [1000, 30_000, 500_000])
@pytest.mark.parametrize("first", [0, 120])
def test_a_training_of_a_thousand_steps_has_two_hundred_records_whatever_its_schedule(first: int, last: int) -> None:
    steps = recorded(first, last, first + 1000)
    assert steps[:101] == list(range(first, first + 101))
    assert 200 <= len(steps) <= 260


def test_a_whole_training_is_recorded_evenly_in_the_logarithm_of_its_steps() -> None:
    steps = recorded(120, 30_000, 30_000)
    assert 300 <= len(steps) <= 450
    assert (steps[0], steps[-1]) == (120, 30_000)
    late = np.diff(np.log1p(np.array(steps[:-1]) - 120))[150:]
    assert late.max() < 2 * np.median(late)


def test_bins_hold_the_weight() -> None:
    ray = make_ray()
    edges = np.linspace(ray.near, ray.far, BINS + 1)
    row = binned(ray, edges)
    assert row.sum() == pytest.approx(ray.passes[-1].weights.sum(), abs=1e-3)
    peak = ray.passes[-1].t[ray.passes[-1].weights.argmax()]
    assert abs(edges[row.argmax()] - peak) < 0.1
    none = replace(ray.passes[-1], **{name: np.zeros(0) for name in ("t", "until", "weights")})
    assert not binned(replace(ray, passes=(none,)), edges).any()


def test_the_depth_is_the_median_and_nan_where_the_opacity_is_under_a_half() -> None:
    recorder = HistoryRecorder(0, 100)
    recorder.add(make_ray(step=0))
    recorder.add(replace(make_ray(step=1), opacity=0.4, depth_median=None))
    history = recorder.view()
    assert history is not None
    assert history.depth[0] == make_ray().depth_median
    assert np.isnan(history.depth[1])


def test_rewinding_drops_the_later_records() -> None:
    recorder = HistoryRecorder(0, 100)
    for step in (0, 1, 2, 5):
        recorder.add(make_ray(step=step))
    recorder.add(make_ray(step=5))  # the same step again makes no new record
    recorder.rewind(2)
    history = recorder.view()
    assert history is not None
    assert history.steps.tolist() == [0, 1, 2]
    for step in range(3, 101):
        if recorder.due(step):
            recorder.add(make_ray(step=step))
    history = recorder.view()
    assert history is not None
    assert history.steps.tolist() == list(range(101))  # a schedule this short records every step, also if trained twice
    empty = HistoryRecorder(0, 100)
    assert empty.view() is None


@pytest.mark.parametrize(("first", "last"), [(0, 100), (100, 100), (30_000, 30_000), (7, 20_000)])
def test_records_past_the_schedule_become_rarer(first: int, last: int) -> None:
    due = recorded(first, last, first + 100_000)
    assert due[0] == first
    assert due[-1] > first + 90_000
    assert len(due) < 500
    assert due[-1] - due[-2] > 1000


def test_without_samples_a_record_has_colour_and_depth_but_no_weights() -> None:
    recorder, ray = HistoryRecorder(0, 100), bare_ray()
    recorder.add(replace(ray, step=0))
    recorder.add(replace(ray, step=1, depth_expected=None))
    history = recorder.view()
    assert history is not None
    assert history.weights.shape == (2, BINS)
    assert np.isnan(history.weights).all()
    np.testing.assert_array_equal(history.depth, [3.8, np.nan])
    np.testing.assert_array_equal(history.color[0], ray.color)
