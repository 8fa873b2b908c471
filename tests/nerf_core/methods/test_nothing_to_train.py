"""A method without parameters: command line, run folder and worker say that there is nothing to train, and go on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from desk import Desk, view_of

from nerf_core.cli import main
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import Inspect, OpenScene, PinRay, SaveCheckpoint, Train
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

SETTINGS = RunSettings(method="nearest-view", device="cpu", threads=1)


@pytest.mark.parametrize("more", [[], ["--steps", "7"], ["--seconds", "9"]])
def test_train_writes_a_run_that_can_be_measured(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    out = tmp_path / "run"
    start = ["train", str(capture), "--out", str(out), "--method", "nearest-view", "--device", "cpu", "--threads", "1"]
    assert main([*start, *more]) == 0
    saved = out / "checkpoints" / "step_00000000.safetensors"
    assert capsys.readouterr().out.splitlines()[-1] == (
        f"nothing to train: method nearest-view has no parameters; saved {saved}"
    )
    assert saved.exists()
    if more:
        return
    assert main(["train", "--resume", "--out", str(out)]) == 0
    assert main(["eval", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["method"], metrics["step"]) == ("nearest-view", 0)
    assert 5 < metrics["mean"]["psnr"] < 25  # the photo beside it
    assert main(["eval", str(out), "--split", "train"]) == 0
    assert json.loads((out / "metrics.json").read_text())["mean"]["psnr"] == 100  # each is its own nearest
    assert main(["probe", str(out), "--camera", "test/r_5.png", "--pixel", "3", "4"]) == 0
    assert "the method keeps no samples along a ray: there is no σ, no w and no T, and no verdict" in (
        capsys.readouterr().out
    )


def test_a_schedule_cannot_be_asked_for(scene: Scene) -> None:
    assert Trainer(scene, RunSettings(method="nearest-view", device="cpu", threads=1, steps=50)).total_steps == 0


def test_a_worker_finishes_at_once_and_its_rays_are_opened(
    open_desk: Callable[..., Desk], capture: Path, tmp_path: Path
) -> None:
    desk = open_desk(opened=False)
    desk.send(OpenScene(capture, SETTINGS, train=True))
    shown = desk.until(lambda s: s.status == "finished")
    assert (shown.total_steps, shown.step, shown.seconds_left) == (0, 0, None)
    for steps in (None, 1):
        (number,) = desk.send(Train(steps))
        assert desk.until_answered(number).text == "nothing to train: method nearest-view has no parameters"
    assert desk.worker.snapshot().status == "finished"
    assert shown.scene is not None
    desk.worker.request_view(view_of(shown.scene, 1))
    shown = desk.until(lambda s: s.preview is not None and s.preview.complete)
    assert shown.preview is not None
    assert shown.preview.caption == "the training photo train/r_0.png, taken from here"
    camera = shown.preview.camera
    desk.send(Inspect(camera, (6, 6), id=4), PinRay(camera, (6, 6), id=4))
    shown = desk.until(lambda s: s.opened_look > 0 and bool(s.pins) and s.pins[0].history is not None)
    assert shown.opened is not None
    assert [stage.title for stage in shown.opened.walk[2:5]] == ["Nearest photo", "Place in the photo", "Colour"]
    assert shown.opened.verdict is None
    desk.send(SaveCheckpoint(tmp_path / "a.safetensors"))
    desk.until_told("saved step 0")
    desk.send(*[OpenScene(capture, SETTINGS, checkpoint=tmp_path / "a.safetensors")])
    desk.until_told("loaded a.safetensors")
    (pin,) = desk.until(lambda s: bool(s.pins) and s.pins[0].history is not None).pins
    assert pin.history is not None
    assert np.isnan(pin.history.weights).all()  # it has no samples, and so no weights
    assert np.isfinite(pin.history.color).all()
    assert checkpoint.describe(tmp_path / "a.safetensors")["step"] == 0
