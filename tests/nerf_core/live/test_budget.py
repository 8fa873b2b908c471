"""The time budget, on a simulated clock, and the rules that decide about training's share."""

from __future__ import annotations

from itertools import product

import pytest

from nerf_core.live.budget import Budget
from nerf_core.live.shares import SHARES, Situation


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
@pytest.mark.parametrize("tile", [0.001, 0.03])
def test_training_gets_its_share_of_the_time(share: float, tile: float) -> None:
    clock = Clock()
    budget = Budget(share, clock)
    trained = drawn = 0.0
    for _ in range(5000):
        clock.now += 0.01
        budget.trained(0.01)
        trained += 0.01
        while budget.may_draw():
            clock.now += tile
            budget.drew(tile)
            drawn += tile
    assert trained / (trained + drawn) == pytest.approx(share, abs=0.02)
    # the measured share may be off by the tile in progress
    assert budget.train_share() == pytest.approx(share, abs=0.03)


def test_a_new_share_takes_over_within_seconds() -> None:
    clock = Clock()
    budget = Budget(0.9, clock)

    def live(seconds: float) -> None:
        end = clock.now + seconds
        while clock.now < end:
            clock.now += 0.01
            budget.trained(0.01)
            while budget.may_draw():
                clock.now += 0.005
                budget.drew(0.005)

    live(20)
    budget.share = 0.2
    live(20)
    assert budget.train_share() == pytest.approx(0.2, abs=0.02)


def test_an_idle_hour_earns_no_burst() -> None:
    clock = Clock()
    budget = Budget(0.5, clock)
    clock.now += 3600
    budget.trained(3600)
    clock.now += 20
    budget.trained(0.01)
    spent = 0.0
    while budget.may_draw():
        clock.now += 0.01
        budget.drew(0.01)
        spent += 0.01
    assert spent < 10


def test_without_measurements_the_share_is_0_and_drawing_is_allowed() -> None:
    budget = Budget(0.5, Clock())
    assert budget.train_share() == 0
    assert budget.may_draw()


def test_preview_and_export_take_turns() -> None:
    budget = Budget(0.5, Clock())
    turns = []
    for _ in range(4):
        turns.append(budget.artist_is_next())
        budget.drew(0.01)
    assert turns == [True, False, True, False]


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_moving_camera_has_half_of_what_training_leaves(share: float) -> None:
    clock = Clock()
    budget = Budget(share, clock)
    followed = 0.0
    while clock.now < 60:
        clock.now += 0.004
        budget.trained(0.004 * share)
        budget.showed(0.004 * (1 - share))  # the window's frames use all that training leaves
        if budget.may_follow():
            clock.now += 0.01
            budget.drew(0.01)
            budget.followed(0.01)
            followed += 0.01
    assert followed / clock.now == pytest.approx((1 - share) / 2, rel=0.2)


def test_a_moving_camera_waits_a_quarter_of_a_second_at_most() -> None:
    clock = Clock()
    budget = Budget(0.95, clock)
    budget.drew(10.0)
    budget.followed(0.1)
    clock.now += 0.2
    assert not budget.may_follow()
    clock.now += 0.06
    assert budget.may_follow()


@pytest.mark.parametrize("name", SHARES.names())
def test_every_rule_leaves_time_for_training_and_for_pictures(name: str) -> None:
    rule = SHARES.get(name)
    assert rule.label
    assert rule.tip
    for wanted, moving, exporting in product((0.05, 0.3, 0.6, 0.95), (False, True), (False, True)):
        assert 0.05 <= rule.share(wanted, Situation(moving, exporting)) <= 0.95
