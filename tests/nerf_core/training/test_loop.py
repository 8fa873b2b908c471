"""An interrupted and resumed training equals an uninterrupted one; a diverged one leaves its last good state."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from nerf_core.datasets import load_scene
from nerf_core.training import checkpoint, last_save
from nerf_core.training.loop import Goal, Progress, train_run
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Diverged, Trainer

Make = Callable[..., Trainer]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunFolder]:
    folder = RunFolder(tmp_path / "run")
    with folder.claimed():
        yield folder


def assert_same(one: Trainer, other: Trainer) -> None:
    assert one.step_count == other.step_count
    a, b = one.state(), other.state()
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


def reloaded(run: RunFolder, trainer: Trainer) -> Trainer:
    _, description, state, rejected = checkpoint.newest(run.path)
    assert rejected == ()
    return Trainer.resume(trainer.scene, description, state, "cpu")


def test_an_abandoned_step_changes_nothing(make_trainer: Make) -> None:
    straight, abandoned = make_trainer(), make_trainer()
    for _ in range(3):
        straight.step()
    abandoned.step()
    calls = 0

    def yield_callback() -> None:
        nonlocal calls
        calls += 1
        if calls == 3:  # of 4 calls: two chunks, two networks
            raise InterruptedError

    seconds = abandoned.seconds
    with pytest.raises(InterruptedError):
        abandoned.step(yield_callback)
    assert (abandoned.step_count, abandoned.seconds) == (1, seconds)
    abandoned.step()
    abandoned.step()
    assert_same(abandoned, straight)


def test_stopped_and_resumed_is_bit_identical(run: RunFolder, make_trainer: Make) -> None:
    straight, first = make_trainer(), make_trainer()
    for _ in range(6):
        straight.step()
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > 18  # asked 5 times a step: stops in the middle of the fourth

    assert train_run(run, first, Goal(6), stop=stop) is False
    second = reloaded(run, first)
    assert second.step_count == 3
    assert train_run(run, second, Goal(6)) is True
    assert_same(second, straight)
    assert_same(reloaded(run, second), straight)


def test_ends_at_the_first_of_two_limits(run: RunFolder, make_trainer: Make) -> None:
    trainer = make_trainer()
    assert train_run(run, trainer, Goal(10_000, seconds=1e-6))
    assert trainer.step_count == 1
    assert train_run(run, trainer, Goal(4, seconds=1e6))
    assert trainer.step_count == 4


def test_saves_during_training_and_keeps_two(run: RunFolder, make_trainer: Make) -> None:
    train_run(run, make_trainer(), Goal(5), save_every=1e-9)
    assert [p.stem for p in run.checkpoints()] == ["step_00000004", "step_00000005"]


def test_log_and_progress(
    run: RunFolder, make_trainer: Make, tiny: RunSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerf_core.training.loop.LOG_SECONDS", 0.0)
    monkeypatch.setattr("nerf_core.training.loop.SHOW_SECONDS", 0.0)
    shown: list[Progress] = []
    trainer = make_trainer()
    run.begin(None, tiny, trainer)
    train_run(run, trainer, Goal(4), show=shown.append)
    lines = [json.loads(line) for line in run.log_file.read_text(encoding="utf-8").splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert all(set(line) == {"step", "loss", "psnr", "rays_per_second", "seconds"} for line in lines)
    assert all(math.isclose(line["psnr"], -10 * math.log10(line["loss"])) for line in lines)
    assert lines[-1]["seconds"] == trainer.seconds
    assert [p.fraction for p in shown] == [0.25, 0.5, 0.75, 1.0]
    assert shown[0].rays_per_second == pytest.approx(lines[0]["rays_per_second"])
    assert shown[-1].seconds_left == 0.0


def test_diverged_leaves_the_last_good_state(run: RunFolder, make_trainer: Make) -> None:
    trainer = make_trainer(learning_rate=1e30)
    with pytest.raises(Diverged, match=r"lower the learning rate.*; went back to step 0 and saved it"):
        train_run(run, trainer, Goal(50))
    good = reloaded(run, trainer)
    assert good.step_count == 0
    assert all(v.isfinite().all() for v in good.state().values())


def test_broken_weights_are_never_saved(run: RunFolder, make_trainer: Make) -> None:
    """A step computes its loss before it updates the weights, so the loss may be finite while the weights are not."""
    trainer = make_trainer()

    def show(progress: Progress) -> None:
        if progress.step == 3:
            trainer.method.parameters()[0].data[0, 0] = torch.nan

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nerf_core.training.loop.SHOW_SECONDS", 0.0)
        with pytest.raises(Diverged, match=r"step 3: method.* is not finite; .* went back to step 2 and saved it"):
            train_run(run, trainer, Goal(5), save_every=1e-9, show=show)
    assert [p.stem for p in run.checkpoints()] == ["step_00000001", "step_00000002"]


def test_an_interrupt_while_weights_are_broken_saves_the_last_good_state(run: RunFolder, make_trainer: Make) -> None:
    trainer = make_trainer()

    def stop() -> bool:
        if trainer.step_count == 2:
            trainer.method.parameters()[0].data[0, 0] = torch.nan
        return trainer.step_count == 2

    with pytest.raises(Diverged, match=r"step 2: method.* is not finite; .* went back to step 0 and saved it"):
        train_run(run, trainer, Goal(5), stop=stop)
    assert reloaded(run, trainer).step_count == 0


def test_a_failed_save_during_training_is_a_warning(run: RunFolder, make_trainer: Make) -> None:
    folder, warnings = run.path / "checkpoints", []
    folder.rmdir()
    folder.write_text("in the way")

    def warn(text: str) -> None:
        warnings.append(text)
        folder.unlink(missing_ok=True)

    assert train_run(run, make_trainer(), Goal(3), save_every=1e-9, warn=warn)
    assert len(warnings) == 1
    assert str(folder / "step_00000001.safetensors") in warnings[0]
    assert [p.stem for p in run.checkpoints()] == ["step_00000002", "step_00000003"]
    shutil.rmtree(folder)


@pytest.mark.parametrize(("stopped", "advice"), [(True, "Ctrl-C"), (False, "Ctrl-C twice")])
def test_a_slow_last_save_is_told_of(
    stopped: bool, advice: str, run: RunFolder, make_trainer: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(last_save, "TELL_SECONDS", 0.2)
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (time.sleep(0.5), real(number)))  # a slow disk
    trainer, warnings = make_trainer(), []
    train_run(run, trainer, Goal(1), warn=warnings.append, save_every=1e9, stop=lambda: stopped)
    step = 0 if stopped else 1
    assert re.fullmatch(rf"saving step {step} takes 0\.[2-4] s so far; {advice} ends without saving", warnings[0])
    assert checkpoint.newest(run.path)[1]["step"] == step


def test_a_run_whose_folder_takes_nothing_is_saved_elsewhere(
    run: RunFolder, make_trainer: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    (run.path / "checkpoints").rmdir()
    (run.path / "checkpoints").touch()  # a file: nothing can be written into it, not even by root
    trainer, warnings = make_trainer(), []
    assert train_run(run, trainer, Goal(2), warn=warnings.append, save_every=1e9) is True
    (saved,) = (tmp_path / "data").rglob("*.safetensors")
    own = checkpoint.step_path(run.path, 2)
    assert [text.partition(": cannot be written: ")[0] for text in warnings[:-1]] == [str(own)]
    assert warnings[-1] == f"step 2 is saved to {saved}: move it to {own}, to continue the run"
    assert checkpoint.load(saved)[0]["step"] == 2
    assert "left_off" not in checkpoint.load(saved)[0]  # the run has no config.json that says where its capture is


def test_what_is_saved_elsewhere_says_where_its_capture_is(
    run: RunFolder,
    make_trainer: Make,
    capture: Path,
    tiny: RunSettings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    trainer = make_trainer()
    run.begin(capture, tiny, trainer)
    (run.path / "checkpoints").rmdir()
    (run.path / "checkpoints").touch()
    train_run(run, trainer, Goal(1), save_every=1e9)
    (saved,) = (tmp_path / "data").rglob("*.safetensors")
    assert checkpoint.load(saved)[0]["left_off"] == {"capture": str(capture), "load": asdict(tiny.load)}


@pytest.mark.parametrize(
    ("method", "names"),
    [("voxels", ["rate_color", "rate_view", "rate_gloss", "rate_density"]), ("nerf", ["learning_rate"])],
)
def test_the_advice_names_constants_that_the_method_has(
    capture: Path, tiny: RunSettings, method: str, names: list[str]
) -> None:
    trainer = Trainer(load_scene(capture, tiny.load), RunSettings(method=method, device="cpu", load=tiny.load))
    assert trainer.advice == f"lower the learning rate ({' or '.join(f'--set {name}=…' for name in names)})"
