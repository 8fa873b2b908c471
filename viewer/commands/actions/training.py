"""Commands that start and stop training."""

from __future__ import annotations

from nerf_core.common.language import marked
from nerf_core.live.messages import Pause, Train

from ...model.state import Action, AppState
from ..registry import command, scene_is_open


@command("training.toggle", marked("Train or pause"), "Training", 1, keys=("Space",), enabled=scene_is_open)
def toggle(state: AppState) -> list[Action]:
    return [Pause() if state.snapshot.status == "training" else Train()]


@command("training.step", marked("One training step"), "Training", 2, keys=(".",), enabled=scene_is_open)
def step(_: AppState) -> list[Action]:
    return [Train(1)]
