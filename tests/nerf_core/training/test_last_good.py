"""The state to fall back on is complete and finite, and further training does not change it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from nerf_core.training.last_good import LastGood
from nerf_core.training.trainer import Diverged, Trainer

MakeTrainer = Callable[..., Trainer]


def test_restoring_goes_back_to_the_remembered_step(make_trainer: MakeTrainer) -> None:
    trainer, straight = make_trainer(), make_trainer()
    trainer.step()
    good = LastGood(trainer)
    for _ in range(3):
        trainer.step()
    good.restore(trainer)
    assert trainer.step_count == 1
    for _ in range(2):
        straight.step()
    trainer.step()
    ours, theirs = trainer.state(), straight.state()
    assert [name for name in ours if not torch.equal(ours[name], theirs[name])] == []


def test_broken_weights_are_not_remembered(make_trainer: MakeTrainer) -> None:
    trainer = make_trainer()
    good = LastGood(trainer)
    trainer.step()
    trainer.method.parameters()[0].data[0, 0] = torch.nan
    with pytest.raises(Diverged, match=r"step 1: method\..* is not finite"):
        good.remember(trainer)
    good.restore(trainer)
    assert trainer.step_count == 0
    assert all(bool(v.isfinite().all()) for v in trainer.state().values())


def test_the_next_copy_takes_the_memory_of_the_one_before(make_trainer: MakeTrainer) -> None:
    trainer = make_trainer()
    good = LastGood(trainer)
    before = good.state
    trainer.step()
    good.remember(trainer)
    assert sum(good.state[name] is value for name, value in before.items()) >= len(before) - 2  # the history has grown
    ours = trainer.state()
    assert [name for name, value in good.state.items() if not torch.equal(value, ours[name])] == []
    assert {v.data_ptr() for v in good.state.values() if v.numel()} & {v.data_ptr() for v in ours.values()} == set()


def test_rounded_large_tensors_take_half_the_memory_and_change_little(
    make_trainer: MakeTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerf_core.training.last_good.PART", 100)
    trainer = make_trainer()
    trainer.step()
    before = {name: value.clone() for name, value in trainer.state().items()}
    good = LastGood(trainer, rounded=True)
    large = {name for name, value in before.items() if value.dtype == torch.float32 and value.numel() > 100}
    assert large
    assert {name for name, value in good.state.items() if value.dtype == torch.bfloat16} == large
    for _ in range(2):
        trainer.step()
    good.restore(trainer)
    assert trainer.step_count == 1
    for name, value in trainer.state().items():
        assert value.dtype == before[name].dtype
        if name in large:
            torch.testing.assert_close(value, before[name], rtol=2**-8, atol=0)
        else:
            assert torch.equal(value, before[name])
    trainer.step()  # goes on
    good.remember(trainer)


def test_numbers_that_rounding_makes_infinite_are_not_remembered(
    make_trainer: MakeTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerf_core.training.last_good.PART", 100)
    trainer = make_trainer()
    weights = next(p for p in trainer.method.parameters() if p.numel() > 100)
    weights.data.view(-1)[0] = torch.finfo(torch.float32).max
    LastGood(trainer)
    with pytest.raises(Diverged, match="is not finite"):
        LastGood(trainer, rounded=True)
