"""Two models at once: runs of one worker share its time, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from desk import Desk, view_of

from nerf_core.common.errors import UserError
from nerf_core.live.messages import (
    CloseRun,
    Inspect,
    OpenRun,
    Pause,
    Reset,
    SaveCheckpoint,
    SetShare,
    Train,
    UseMethod,
)
from nerf_core.live.scheduler import Scheduler

OpenDesk = Callable[..., Desk]


def test_two_runs_of_two_methods_train_on_one_scene_fairly(open_desk: OpenDesk) -> None:
    desk = open_desk(steps=100_000)
    desk.send(OpenRun("voxels", run=2))
    desk.until(lambda _: 2 in desk.worker.snapshots())
    first, second = desk.worker.snapshot(), desk.worker.snapshot(2)
    assert (first.method, second.method) == ("nerf", "voxels")
    assert first.scene is second.scene
    desk.trained(3)  # so that the loops are compiled
    desk.send(Train(2, run=2))
    desk.until(lambda _: desk.worker.snapshot(2).step == 2)
    before = desk.worker.snapshot().seconds, desk.worker.snapshot(2).seconds
    desk.send(Train(), Train(run=2))
    desk.until(lambda s: s.seconds - before[0] + desk.worker.snapshot(2).seconds - before[1] > 2)
    desk.send(Pause(), Pause(run=2))
    desk.until(lambda s: s.status == "paused" and desk.worker.snapshot(2).status == "paused")
    took = desk.worker.snapshot().seconds - before[0], desk.worker.snapshot(2).seconds - before[1]
    assert 0.7 < took[0] / took[1] < 1 / 0.7  # equal time, although one's steps take longer
    assert desk.worker.snapshot().rays_per_second == 0


def test_runs_do_not_disturb_each_other(open_desk: OpenDesk) -> None:
    """A run's weights are those of a run alone. Each run has its own views, opened rays and resets."""
    alone, both = open_desk(), open_desk()
    alone.trained(5)
    both.send(OpenRun("voxels", run=2))
    both.until(lambda _: 2 in both.worker.snapshots())
    scene = both.worker.snapshot().scene
    assert scene is not None
    both.send(Train(5), Train(5, run=2))
    both.worker.request_view(view_of(scene, 1))
    both.until(lambda s: s.step == 5 and both.worker.snapshot(2).step == 5)
    assert both.worker.snapshot().history.loss.tolist() == alone.worker.snapshot().history.loss.tolist()
    asked = Inspect(scene.views[0].camera, (8, 8), run=2)
    both.send(asked)
    both.until(lambda _: both.worker.snapshot(2).opened_look == asked.look)
    assert both.worker.snapshot().opened is None
    assert both.worker.snapshot(2).preview is None
    both.until(lambda s: s.preview is not None and s.preview.stamp == 1)
    both.send(Reset(run=2))
    both.until(lambda _: both.worker.snapshot(2).step == 0)
    assert both.worker.snapshot().step == 5


def test_wrong_run_numbers_are_reported(open_desk: OpenDesk) -> None:
    desk = open_desk()
    (number,) = desk.send(Train(run=3))
    told = desk.until_told("there is no run 3: there are 1")
    assert (told.kind, told.command, told.run) == ("failed", number, 3)
    desk.send(OpenRun("voxels"), CloseRun())
    desk.until_told("run 1 is open already: close it first, or take another number")
    desk.until_told("the first run stays open")
    desk.send(OpenRun("wings", run=2))
    desk.until_told("unknown method 'wings'")
    assert set(desk.worker.snapshots()) == {1}
    desk.send(OpenRun("voxels", run=2), UseMethod("hash", run=2))
    desk.until(lambda _: 2 in desk.worker.snapshots() and desk.worker.snapshot(2).method == "hash")
    desk.send(CloseRun(run=2))
    desk.until(lambda _: set(desk.worker.snapshots()) == {1})
    assert desk.worker.snapshot().method == "nerf"


def test_a_fault_in_a_command_stops_only_the_run_that_it_was_for(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk(steps=1_000_000)
    desk.send(OpenRun("voxels", run=2))
    desk.until(lambda _: 2 in desk.worker.snapshots())

    def broken(*_: object) -> None:
        raise RuntimeError("a broken writer")

    monkeypatch.setattr("nerf_core.live.run.Run._save", broken)
    desk.send(Train(), SaveCheckpoint(Path("x.safetensors"), run=2))
    told = desk.until_told("the worker failed: RuntimeError: a broken writer")
    assert told.run == 2
    assert desk.worker.snapshot(2).status == "failed"
    assert desk.worker.snapshot().status == "training"
    monkeypatch.setattr("nerf_core.live.run.Run.use_method", broken)
    (number,) = desk.send(OpenRun("voxels", run=3))
    desk.until(lambda _: any(notice.command == number for notice in desk.heard))
    assert desk.heard[-1].run == 3
    assert desk.worker.snapshot().status == "training"


def test_an_unknown_share_rule_is_reported(open_desk: OpenDesk) -> None:
    desk = open_desk()
    desk.send(SetShare(0.3, "greedy"), SetShare(0.4))
    desk.until_told("unknown share rule 'greedy': choose one of steady")
    assert desk.until(lambda s: s.wanted_share == 0.4).share_rule == "steady"


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Fake:
    """A run whose steps take `seconds`."""

    def __init__(self, number: int, seconds: float) -> None:
        self.number, self.seconds, self.training, self.total = number, seconds, True, 0.0


def live(scheduler: Scheduler, clock: Clock, runs: list[Fake], seconds: float) -> None:
    end = clock.now + seconds
    while clock.now < end:
        number = scheduler.next_run(runs)
        run = next(run for run in runs if run.number == number)
        clock.now += run.seconds
        run.total += run.seconds
        scheduler.trained(run.number, run.seconds, 64)


@pytest.mark.parametrize("steps", [(0.01, 0.01), (0.001, 0.3), (0.02, 0.005, 0.1)])
def test_runs_get_equal_time_however_long_their_steps_are(steps: tuple[float, ...]) -> None:
    clock = Clock()
    scheduler, runs = Scheduler(0.6, clock), [Fake(k, seconds) for k, seconds in enumerate(steps)]
    live(scheduler, clock, runs, 60)
    for run in runs:
        assert run.total == pytest.approx(60 / len(runs), rel=0.05)
    assert scheduler.rays_per_second(0) == pytest.approx(64 / steps[0] / len(runs), rel=0.3)


def test_a_run_that_joins_neither_waits_nor_catches_up() -> None:
    clock = Clock()
    scheduler, runs = Scheduler(0.6, clock), [Fake(1, 0.01), Fake(2, 0.01)]
    runs[1].training = False
    live(scheduler, clock, runs, 30)
    runs[1].training = True
    runs[0].total = 0.0
    live(scheduler, clock, runs, 2)
    assert runs[0].total == pytest.approx(1, rel=0.05)
    runs[0].training = runs[1].training = False
    assert scheduler.next_run(runs) is None


def test_an_unknown_rule_changes_nothing() -> None:
    scheduler = Scheduler(0.6)
    with pytest.raises(UserError, match="unknown share rule"):
        scheduler.set_share(0.2, "nobody")
    assert (scheduler.wanted, scheduler.rule) == (0.6, "steady")
