"""The loss history of a long training stays small and exact."""

from __future__ import annotations

import numpy as np
import pytest

from nerf_core.training.loss_history import LIMIT, HistoryLog


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


def test_a_view_is_cached_until_a_step_is_added() -> None:
    log = HistoryLog()
    assert len(log.view().step) == 0
    log.add(1, 0.5)
    first = log.view()
    assert log.view() is first
    log.add(2, 0.0)
    assert len(first.step) == 1
    assert log.view().psnr[1] == pytest.approx(100)  # not infinity


@pytest.mark.parametrize("steps", [0, 3, LIMIT + 5, 5 * LIMIT + 3])
def test_a_log_goes_on_from_its_state(steps: int) -> None:
    losses = np.random.default_rng(0).uniform(0.01, 1, steps + 700).tolist()
    whole, first, second = HistoryLog(), HistoryLog(), HistoryLog()
    second.add(1, 0.3)  # of another run: load_state drops it
    for step, loss in enumerate(losses, 1):
        whole.add(step, loss)
        (first if step <= steps else second).add(step, loss)
        if step == steps:
            second.load_state(first.state(), steps)
    if not steps:
        second.load_state({}, 5)
        for step, loss in enumerate(losses, 1):
            second.add(step, loss)
    for name in ("step", "loss", "psnr"):
        np.testing.assert_array_equal(getattr(second.view(), name), getattr(whole.view(), name))


def numbers(*values: float) -> np.ndarray:
    return np.array(values, np.float64)


BROKEN = {
    "no losses": {"losses": None},
    "another length": {"losses": numbers(1, 1)},
    "a column": {"steps": np.ones((3, 1), np.int64), "losses": numbers(1, 1, 1)[:, None]},
    "steps that go back": {"steps": np.array([2, 1, 3])},
    "steps before the first": {"steps": np.array([0, 1, 2])},
    "a step that was not made": {"steps": np.array([1, 2, 4])},
    "steps that are fractions": {"steps": numbers(1, 2, 3)},
    "a loss that is NaN": {"losses": numbers(1, np.nan, 1)},
    "a negative loss": {"losses": numbers(1, -1, 1)},
    "a loss that is too large": {"losses": numbers(1, 1e300, 1)},
    "complex losses": {"losses": np.ones(3, np.complex64)},
    "means over no steps": {"every": np.array(0)},
    "means over three steps": {"every": np.array(3)},
    "means over too many steps": {"every": np.array(2**62)},
    "means over infinitely many steps": {"every": np.array(np.inf)},
    "several lengths of means": {"every": np.ones(2, np.int64)},
    "enough pending losses for a mean": {"pending": numbers(1)},
    "an infinite pending loss": {"every": np.array(4), "pending": numbers(np.inf)},
}


@pytest.mark.parametrize("changes", BROKEN.values(), ids=BROKEN.keys())
def test_an_invalid_state_is_refused(changes: dict[str, np.ndarray | None]) -> None:
    log = HistoryLog()
    for step in (1, 2, 3):
        log.add(step, 0.5)
    state = {name: v for name, v in (log.state() | changes).items() if v is not None}
    HistoryLog().load_state(log.state(), 3)
    with pytest.raises((KeyError, ValueError)):
        HistoryLog().load_state(state, 3)


def test_a_state_with_too_many_points_is_refused() -> None:
    steps = np.arange(1, LIMIT + 1)
    state = HistoryLog().state() | {"steps": steps, "losses": np.ones(LIMIT)}
    with pytest.raises(ValueError, match="not those of"):
        HistoryLog().load_state(state, LIMIT)
