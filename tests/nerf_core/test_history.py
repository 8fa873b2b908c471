"""A plot of a long training stays small and true."""

from __future__ import annotations

import numpy as np
import pytest

from nerf_core.history import LIMIT, HistoryLog


@pytest.mark.parametrize("steps", [1, LIMIT - 1, LIMIT, LIMIT + 1, 3 * LIMIT, 10 * LIMIT + 7])
def test_points_are_means_of_equally_many_steps(steps: int) -> None:
    losses = np.random.default_rng(0).uniform(0.01, 1, steps)
    log = HistoryLog()
    for step, loss in enumerate(losses, 1):
        log.add(step, float(loss))
    view = log.view()
    points = steps // log.every
    assert points + 1 >= LIMIT // 2 or log.every == 1
    assert len(view.step) == points < LIMIT
    np.testing.assert_array_equal(view.step, np.arange(1, points + 1) * log.every)
    means = losses[: points * log.every].reshape(points, log.every).mean(-1)
    np.testing.assert_allclose(view.loss, means, rtol=1e-5)
    np.testing.assert_allclose(view.psnr, -10 * np.log10(means), rtol=1e-4)


def test_a_view_is_made_once_for_what_it_shows() -> None:
    log = HistoryLog()
    assert len(log.view().step) == 0
    log.add(1, 0.5)
    first = log.view()
    assert log.view() is first
    log.add(2, 0.0)
    assert len(first.step) == 1
    assert log.view().psnr[1] == pytest.approx(100)  # not infinity


def test_rewinding_forgets_what_came_after() -> None:
    log = HistoryLog()
    for step in range(1, 11):
        log.add(step, 1 / step)
    log.rewind(4)
    log.add(5, 7.0)
    assert log.view().step.tolist() == [1, 2, 3, 4, 5]
    assert log.view().loss[-1] == 7
