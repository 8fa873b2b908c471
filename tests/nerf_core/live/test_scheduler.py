"""Rates are told only if there is something to estimate them from."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from nerf_core.live.scheduler import Scheduler


@dataclass
class Trainee:
    number: int = 1
    training: bool = True


def test_no_rate_is_told_from_what_was_long_ago_or_has_just_begun() -> None:
    now = 0.0
    scheduler = Scheduler(0.6, lambda: now)
    scheduler.next_run([Trainee()])
    scheduler.trained(1, 0.01, 4096)
    assert scheduler.rays_per_second(1) == 0.0  # one step: it may have compiled something
    for _ in range(100):
        now += 0.01
        scheduler.trained(1, 0.01, 100)
    assert scheduler.rays_per_second(1) == pytest.approx(10_000, rel=0.5)
    now += 300  # another scene loads meanwhile
    assert scheduler.rays_per_second(1) == 0.0


def test_another_model_has_no_rate_yet() -> None:
    scheduler = Scheduler(0.6, lambda: 0.0)
    scheduler.next_run([Trainee()])
    scheduler.trained(1, 1.0, 1000)
    assert scheduler.rays_per_second(1) == 1000
    scheduler.forget(1)
    scheduler.next_run([Trainee()])
    assert scheduler.rays_per_second(1) == 0.0
