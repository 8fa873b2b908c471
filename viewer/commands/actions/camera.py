"""Commands that move the camera."""

from __future__ import annotations

from nerf_core.common.language import marked

from ...model.state import Action, AppState, FrameScene, GoToView, ResetView
from ..registry import command, scene_is_open


@command("camera.frame", marked("Frame the scene"), "Camera", 1, keys=("F",), menu="View", enabled=scene_is_open)
def frame(_: AppState) -> list[Action]:
    return [FrameScene()]


@command("camera.reset", marked("Reset the view"), "Camera", 2, keys=("R",), menu="View", enabled=scene_is_open)
def reset(_: AppState) -> list[Action]:
    return [ResetView()]


def has_photos(state: AppState) -> bool:
    scene = state.snapshot.scene
    return scene is not None and bool(scene.split("train"))


@command("camera.next", marked("Next training photo"), "Camera", 3, keys=("→",), repeat=True, enabled=has_photos)
def following(state: AppState) -> list[Action]:
    return [GoToView(_neighbour(state, 1))]


@command(
    "camera.previous", marked("Previous training photo"), "Camera", 4, keys=("←",), repeat=True, enabled=has_photos
)
def previous(state: AppState) -> list[Action]:
    return [GoToView(_neighbour(state, -1))]


def _neighbour(state: AppState, step: int) -> int:
    """The index of the next (or previous) training photo, cyclic; without a current one, of the first (or last)."""
    assert state.snapshot.scene is not None
    train, current = state.snapshot.scene.split("train"), state.current_view
    if current not in train:
        return train[0 if step > 0 else -1]
    return train[(train.index(current) + step) % len(train)]
