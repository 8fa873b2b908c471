"""The history of a pinned ray: which steps are recorded, and what a record holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from panel_states import make_ray

from nerf_core.probe.history import BINS, RECORDS, HistoryRecorder, binned, log_spaced


@pytest.mark.parametrize("last", [0, 1, 5, 199, 200, 1000, 30_000, 500_000])
def test_steps_are_even_in_their_logarithm(last: int) -> None:
    steps = log_spaced(last, 200)
    assert len(steps) >= min(200, last + 1)
    assert (steps[0], steps[-1]) == (0, last)
    assert (np.diff(steps) > 0).all()
    if last >= 30_000:
        late = np.diff(np.log1p(steps))[steps[1:] > 100]
        assert late.max() < 2 * np.median(late)


def test_a_whole_training_has_over_two_hundred_records() -> None:
    recorder, taken = HistoryRecorder(120, 30_000), []
    for step in range(120, 30_001):
        if recorder.due(step):
            recorder.add(make_ray(step=step))
            taken.append(step)
    history = recorder.view()
    assert history is not None
    assert history.steps.tolist() == taken
    assert 200 <= len(taken) <= 1.3 * RECORDS
    assert (taken[0], taken[-1]) == (120, 30_000)
    assert history.weights.shape == (len(taken), BINS)


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
    recorder, due = HistoryRecorder(first, last), list[int]()
    for step in range(first, first + 100_000):
        if recorder.due(step):
            due.append(step)
            recorder._next += 1
    assert due[0] == first
    assert due[-1] > first + 90_000
    assert len(due) < 700
    assert due[-1] - due[-2] > 1000
