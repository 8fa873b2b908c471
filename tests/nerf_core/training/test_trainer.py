"""A run gives the same weights however often it is stopped and resumed."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerf_core.common.device import usable_cores
from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import traced
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Diverged, Trainer, psnr_of

MakeTrainer = Callable[..., Trainer]


def differing(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> list[str]:
    assert a.keys() == b.keys()
    return [name for name in a if not torch.equal(a[name], b[name])]


def copied(trainer: Trainer) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in trainer.state().items()}


def stored(trainer: Trainer) -> dict[str, Any]:
    return json.loads(json.dumps(trainer.describe()))


def run(trainer: Trainer, steps: int, yield_callback: Callable[[], None] = lambda: None) -> Trainer:
    for _ in range(steps):
        trainer.step(yield_callback)
    return trainer


def test_a_checkpoint_without_a_loss_history_continues(make_trainer: MakeTrainer) -> None:
    first = run(make_trainer(), 3)
    state = {name: value for name, value in copied(first).items() if not name.startswith("history.")}
    assert len(state) < len(first.state())
    second = run(Trainer.resume(first.scene, stored(first), state, "cpu"), 2)
    assert second.history.view().step.tolist() == [4, 5]
    assert run(first, 2).history.view().step.tolist() == [1, 2, 3, 4, 5]
    assert [name for name in differing(first.state(), second.state()) if not name.startswith("history.")] == []


def test_a_seed_fixes_the_weights(make_trainer: MakeTrainer) -> None:
    a, b, c = (run(make_trainer(seed), 8) for seed in (1, 1, 2))
    assert differing(a.state(), b.state()) == []
    assert differing(a.state(), c.state()) != []


def test_watching_changes_nothing(make_trainer: MakeTrainer, scene: Scene) -> None:
    watched, alone = make_trainer(density_noise=0.5), make_trainer(density_noise=0.5)
    rays = camera_rays(scene.views[5].camera, scene.near, scene.far)[:40]

    def look() -> None:
        watched.method.render(rays, "coarse")
        traced(watched.method, rays[:8])
        watched.method.radiance(torch.zeros(1, 3), torch.eye(3))  # pyright: ignore[reportAttributeAccessIssue]: a Nerf

    assert differing(run(watched, 6, look).state(), run(alone, 6).state()) == []


@pytest.mark.parametrize("cut", [0, 1, 5])
def test_a_resumed_run_equals_an_uninterrupted_one(make_trainer: MakeTrainer, scene: Scene, cut: int) -> None:
    whole = run(make_trainer(seed=3, density_noise=0.5), 9)
    first = run(make_trainer(seed=3, density_noise=0.5), cut)
    second = Trainer.resume(scene, stored(first), copied(first), "cpu")
    assert second.step_count == cut
    assert second.seconds == first.seconds
    assert differing(run(second, 9 - cut).state(), whole.state()) == []


def test_a_frozen_method_stays_as_it_was(make_trainer: MakeTrainer, scene: Scene) -> None:
    trainer = run(make_trainer(), 2)
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)[100:120]
    frozen, before = trainer.frozen_method(), trainer.method.render(rays).color
    run(trainer, 5)
    assert torch.equal(frozen.render(rays).color, before)
    assert not torch.equal(trainer.method.render(rays).color, before)


def test_a_report_tells_what_the_step_did(make_trainer: MakeTrainer) -> None:
    trainer = make_trainer()
    report = trainer.step()
    assert (report.step, report.rays, trainer.step_count) == (1, 32, 1)
    assert report.psnr == pytest.approx(-10 * math.log10(report.loss))
    assert trainer.seconds == report.seconds > 0


def test_time_in_the_yield_callback_is_not_training(make_trainer: MakeTrainer, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)

    def yield_callback() -> None:
        nonlocal now
        now += 7

    assert make_trainer().step(yield_callback).seconds == 0


def test_a_run_knows_its_length(make_trainer: MakeTrainer, scene: Scene, tiny: RunSettings) -> None:
    assert make_trainer().total_steps == 100
    assert Trainer(scene, replace(tiny, steps=0)).total_steps == 500_000


def rate(trainer: Trainer) -> float:
    return trainer.method.optimizer.param_groups[0]["lr"]  # type: ignore[attr-defined]  # nerf's


def test_the_schedule_spans_the_steps_asked_for(make_trainer: MakeTrainer, scene: Scene, tiny: RunSettings) -> None:
    asked = run(make_trainer(), 51)
    assert rate(asked) == pytest.approx(5e-4 * 0.1 ** (50 / 100))
    own = run(Trainer(scene, replace(tiny, steps=0, changes=tiny.changes | {"decay_steps": "10"})), 6)
    assert rate(own) == pytest.approx(5e-4 * 0.1 ** (5 / 10))


def test_a_nan_loss_stops_training(make_trainer: MakeTrainer) -> None:
    trainer = run(make_trainer(), 1)
    with torch.no_grad():
        trainer.method.parameters()[0].fill_(math.nan)
    with pytest.raises(Diverged, match="step 2: the loss is nan; lower the learning rate"):
        trainer.step()


def test_a_state_of_another_architecture_is_refused(make_trainer: MakeTrainer, scene: Scene) -> None:
    wide, narrow = make_trainer(width=48), make_trainer(width=16)
    with pytest.raises(UserError, match=r"the checkpoint does not fit method nerf .*size mismatch.*: made by another"):
        Trainer.resume(scene, stored(narrow), copied(wide), "cpu")
    with pytest.raises(UserError, match="the checkpoint does not fit method nerf"):
        Trainer.resume(scene, stored(narrow), {}, "cpu")
    with pytest.raises(UserError, match="unknown method 'magic'"):
        Trainer.resume(scene, stored(narrow) | {"method": "magic"}, copied(narrow), "cpu")


def test_out_of_memory_goes_on_in_smaller_chunks(make_trainer: MakeTrainer, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, plain = make_trainer(chunk_rays=32), make_trainer(chunk_rays=8)
    evaluate = trainer.method._field  # pyright: ignore[reportAttributeAccessIssue]: a Nerf

    def limited(name: str, p: Any, u: Tensor, index: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(u) > 8 and name == "fine":
            raise torch.OutOfMemoryError("too many rays")
        return evaluate(name, p, u, index)

    monkeypatch.setattr(trainer.method, "_field", limited)
    first, second = trainer.step(), trainer.step()
    assert first.note == "out of device memory at step 1: going on in chunks of half the size"
    assert second.note == ""
    assert trainer.describe()["config"]["chunk_rays"] == 8
    assert differing(trainer.state(), run(plain, 2).state()) == []


def test_memory_that_never_suffices_raises(make_trainer: MakeTrainer, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("full")

    trainer = make_trainer()
    before = copied(trainer)
    monkeypatch.setattr(trainer.method, "_field", full)
    with pytest.raises(torch.OutOfMemoryError):
        trainer.step()
    assert trainer.method.config.chunk_rays == 1
    assert differing(trainer.state(), before) == []


def test_a_callback_without_memory_does_not_halve_the_chunks(make_trainer: MakeTrainer) -> None:
    def full() -> None:
        raise torch.OutOfMemoryError("a picture")

    trainer = make_trainer()
    before = copied(trainer), trainer.config
    with pytest.raises(torch.OutOfMemoryError, match="a picture"):
        trainer.step(full)
    assert trainer.config == before[1]
    assert differing(trainer.state(), before[0]) == []


def test_a_checkpoint_without_memory_is_not_called_foreign(
    make_trainer: MakeTrainer, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("full")

    trainer = make_trainer()
    monkeypatch.setattr(Trainer, "go_to", full)
    with pytest.raises(torch.OutOfMemoryError):
        Trainer.resume(scene, stored(trainer), copied(trainer), "cpu")


def test_restarted_is_the_same_run_again(make_trainer: MakeTrainer) -> None:
    trainer = make_trainer(seed=4, density_noise=0.5)
    begun, after = copied(trainer), copied(run(trainer, 3))
    again = trainer.restarted()
    assert (again.step_count, again.seconds) == (0, 0.0)
    assert differing(again.state(), begun) == []
    assert differing(run(again, 3).state(), after) == []


def test_a_resumed_run_uses_no_more_threads_than_cores(make_trainer: MakeTrainer, scene: Scene) -> None:
    trainer = make_trainer()
    resumed = Trainer.resume(scene, stored(trainer) | {"threads": 1000}, copied(trainer), "cpu")
    assert resumed.threads == usable_cores()


def test_psnr_of_a_loss() -> None:
    assert psnr_of(0.01) == pytest.approx(20)
    assert psnr_of(0.0) == 100
