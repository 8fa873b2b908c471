"""Pinned rays and their histories come back with a checkpoint and continue; invalid ones are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from desk import PATIENCE, Desk

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import (
    MOST_PINS,
    EditPin,
    ExportRays,
    Inspect,
    LoadCheckpoint,
    Pin,
    PinRay,
    Reset,
    SaveCheckpoint,
    Snapshot,
    Train,
    UnpinRay,
)
from nerf_core.live.pin_files import described, restored_pins, with_histories
from nerf_core.probe import RayHistory
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings

OpenDesk = Callable[..., Desk]
SCHEDULE = 30  # steps of the checkpoint's


def history_of(snapshot: Snapshot, number: int = 1) -> RayHistory:
    found = next(pin.history for pin in snapshot.pins if pin.id == number)
    assert found is not None
    return found


def camera_of(desk: Desk) -> Camera:
    scene = desk.worker.snapshot().scene
    assert scene is not None
    return scene.views[0].camera


@pytest.fixture(scope="module")
def saved(tiny: RunSettings, capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Snapshot]:
    """A checkpoint of step 5 with a ray pinned at step 0 and one pinned at step 3, and what was shown then."""
    desk, file = Desk(replace(tiny, steps=SCHEDULE), capture), tmp_path_factory.mktemp("saved") / "run.safetensors"
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(PinRay(camera, (8, 8), id=1), Train(3))
    desk.until(lambda s: s.step == 3 and s.status == "paused")
    desk.send(PinRay(camera, (2, 2), id=2), Train(2))
    shown = desk.until(
        lambda s: s.step == 5 and s.status == "paused" and len(s.pins) == 2 and history_of(s).steps[-1] == 5
    )
    desk.send(EditPin(2, name="rim"), SaveCheckpoint(file))
    desk.until_told("saved step 5")
    assert desk.worker.stop(PATIENCE)
    return file, shown


def same(a: RayHistory, b: RayHistory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in vars(a))


def test_histories_continue_where_the_checkpoint_left_them(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    (file, before), desk = saved, open_desk()
    desk.send(LoadCheckpoint(file))
    desk.until_told("loaded run.safetensors")
    loaded = desk.worker.snapshot()
    a, b = loaded.pins
    assert [(pin.name, pin.color, pin.pixel) for pin in loaded.pins] == [("ray 1", 0, (8, 8)), ("rim", 1, (2, 2))]
    assert same(history_of(loaded, a.id), history_of(before, 1))
    assert same(history_of(loaded, b.id), history_of(before, 2))
    np.testing.assert_array_equal(loaded.history.step, before.history.step)
    np.testing.assert_array_equal(loaded.history.loss, before.history.loss)

    later = desk.trained(3)
    assert later.history.step.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    later = desk.until(lambda s: history_of(s, a.id).steps[-1] == 8)
    assert history_of(later, a.id).steps.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert history_of(later, b.id).steps.tolist() == [3, 4, 5, 6, 7, 8]


@pytest.mark.thorough(7)
def test_a_restored_pin_of_an_open_ray_is_that_ray(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, file, rays = open_desk(), tmp_path / "run.safetensors", tmp_path / "rays.json"
    asked, twice = Inspect(camera_of(desk), (5, 4)), PinRay(camera_of(desk), (5, 4))
    desk.send(asked, PinRay.of(asked), twice, PinRay(camera_of(desk), (1, 1)), SaveCheckpoint(file))
    desk.until(lambda s: s.opened_look == asked.look)
    before = [pin.id for pin in desk.worker.snapshot().pins]
    desk.send(UnpinRay(before[2]), LoadCheckpoint(file))
    desk.until_told("loaded run.safetensors")
    after = [pin.id for pin in desk.worker.snapshot().pins]
    assert after[:2] == before[:2] == [asked.id, twice.id]
    assert after[2] not in before
    desk.send(ExportRays(rays))
    desk.until_told("wrote")
    assert [ray["name"] for ray in json.loads(rays.read_text())["rays"]] == ["ray 1", "ray 2", "ray 3"]


def test_a_ray_that_is_removed_and_pinned_again_begins_anew(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    desk = open_desk()
    desk.send(LoadCheckpoint(saved[0]))
    desk.until_told("loaded run.safetensors")
    pin = desk.worker.snapshot().pins[1]
    wanted = PinRay(pin.camera, pin.pixel)
    desk.send(UnpinRay(pin.id), wanted)
    again = desk.until(lambda s: [pin.id for pin in s.pins][1:] == [wanted.id] and s.pins[1].history is not None)
    assert history_of(again, wanted.id).steps.tolist() == [5]
    assert again.pins[1].color == 1  # the colour that became free


@pytest.mark.thorough(7)
def test_a_history_continues_past_the_checkpoints_schedule(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    desk = open_desk(steps=20_000)  # the checkpoint's own schedule counts
    desk.send(LoadCheckpoint(saved[0]), Train(SCHEDULE + 10))
    shown = desk.until(lambda s: s.step == SCHEDULE + 15 and s.status != "training" and s.pins[1].history is not None)
    steps = history_of(shown, shown.pins[1].id).steps.tolist()
    assert steps[:3] == [3, 4, 5]
    assert steps[-1] > SCHEDULE
    assert steps == sorted(set(steps))


def test_a_reset_clears_the_loaded_histories(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    desk = open_desk()
    desk.send(LoadCheckpoint(saved[0]), Reset())
    begun = desk.until(lambda s: s.step == 0 and len(s.pins) == 2 and s.pins[1].history is not None)
    assert [history_of(begun, pin.id).steps.tolist() for pin in begun.pins] == [[0], [0]]
    assert len(begun.history.step) == 0


def test_pins_stay_if_the_checkpoint_has_none(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, file = open_desk(), tmp_path / "bare.safetensors"
    desk.trained(2)
    desk.send(SaveCheckpoint(file), PinRay(camera_of(desk), (4, 4), id=9), LoadCheckpoint(file))
    desk.until_told("loaded bare.safetensors")
    (pin,) = desk.worker.snapshot().pins
    assert (pin.id, pin.pixel) == (9, (4, 4))
    assert history_of(desk.worker.snapshot(), 9).steps.tolist() == [2]


def test_the_snapshot_has_the_checkpoint_once_its_loading_is_reported(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot]
) -> None:
    desk = open_desk()
    (number,) = desk.send(LoadCheckpoint(saved[0]))
    told = desk.until_told("loaded run.safetensors")
    assert (told.kind, told.command) == ("loaded", number)
    shown = desk.worker.snapshot()
    assert [pin.name for pin in shown.pins] == ["ray 1", "rim"]
    assert shown.step == 5
    assert shown.history.step.tolist() == [1, 2, 3, 4, 5]


def test_a_checkpoint_without_histories_has_none(saved: tuple[Path, Snapshot]) -> None:
    description, state = checkpoint.load(saved[0])
    pins = restored_pins(description)
    assert all(pin.history is None for pin in pins)
    assert all(pin.history is not None for pin in with_histories(pins, description, state))
    del description["watched"]
    assert all(pin.history is None for pin in with_histories(pins, description, state))


def bad(name: str, change: Callable[[torch.Tensor], Any]) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    def break_it(description: dict[str, Any], state: dict[str, Any]) -> None:
        state[f"watched.{name}"] = change(state[f"watched.{name}"])

    return break_it


def watched(rays: object) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda description, state: description.update(watched=rays)


BROKEN = {
    "a missing tensor": lambda description, state: state.pop("watched.1.weights"),
    "rays that are numbers": watched([1]),
    "a ray without a camera": watched([{"pixel": [1, 1]}]),
    "a number instead of rays": watched(3),
    "more rays than can be pinned": lambda description, state: description.update(watched=description["watched"] * 40),
    "a step that was never made": bad("0.steps", lambda v: v + 1),
    "steps in descending order": bad("0.steps", lambda v: v.flip(0)),
    "steps that are fractions": bad("0.steps", lambda v: v.double()),
    "a step before the first": bad("0.steps", lambda v: v - 1),
    "another length": bad("0.depth", lambda v: v[1:]),
    "no records": bad("1.steps", lambda v: v[:0]),
    "weights that are NaN": bad("0.weights", lambda v: v * torch.nan),
    "weights of a method without samples": lambda description, state: description.update(method="nearest-view"),
    "weights that are integers": bad("0.weights", lambda v: v.long()),
    "more bins": bad("0.weights", lambda v: torch.cat([v, v], 1)),
    "edges that do not rise": bad("1.edges", lambda v: v.flip(0)),
    "an infinite depth": bad("0.depth", lambda v: v + torch.inf),
}


def test_invalid_histories_are_refused(saved: tuple[Path, Snapshot]) -> None:
    for what, break_it in BROKEN.items():
        description, state = checkpoint.load(saved[0])
        break_it(description, state)
        with pytest.raises(UserError, match="histories cannot be read"):
            pytest.fail(f"{what}: accepted as {with_histories([], description, state)}")


def test_a_model_loads_without_its_invalid_histories(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot], tmp_path: Path
) -> None:
    file = tmp_path / "run.safetensors"
    description, state = checkpoint.load(saved[0])
    checkpoint.save(file, description | {"watched": 5}, state)
    desk = open_desk()
    desk.send(LoadCheckpoint(file))
    assert desk.until_told("the checkpoint's pinned rays' histories cannot be read: they begin anew").level == "warning"
    assert desk.worker.snapshot().step == 5  # the snapshot is published before the notice
    assert desk.trained(1).history.step.tolist() == [1, 2, 3, 4, 5, 6]


# ---- names, colours and places -------------------------------------------------------------------------------------


def some(count: int) -> list[Pin]:
    poses = [np.column_stack([np.eye(3), [0.1 * k, 0.0, 4.0]]) for k in range(count)]
    cameras = [Camera(100, 80, 90.0, 90.0, 50.0, 40.0, pose) for pose in poses]
    return [Pin(k + 1, f"ray {k + 1}", k, False, camera, (k, 2 * k)) for k, camera in enumerate(cameras)]


def test_pins_come_back_from_a_checkpoint() -> None:
    pins = some(3)
    pins[1] = replace(pins[1], name="the rim\u202e of it\n", hidden=True)
    pins[2] = replace(pins[2], name="👩\u200d🚀")
    again = restored_pins(json.loads(json.dumps(described(pins))))
    # characters that reverse or break a line are escaped
    assert [pin.name for pin in again] == ["ray 1", r"the rim\u202e of it\n", "👩\u200d🚀"]
    assert [(p.color, p.hidden, p.pixel) for p in again] == [(p.color, p.hidden, p.pixel) for p in pins]
    for a, b in zip(again, pins, strict=True):
        np.testing.assert_array_equal(a.camera.c2w, b.camera.c2w)
        assert a.camera.intrinsics() == b.camera.intrinsics()
    assert restored_pins({}) == restored_pins({"session": {}}) == []
    assert described([]) == {"session": {}, "watched": []}


def changed(**values: Any) -> dict[str, Any]:
    session = described(some(2))["session"]
    session["pins"][0] |= values
    return session


@pytest.mark.parametrize(
    "session",
    [
        {"pins": 3}, {"pins": [3]}, {"pins": [{}]}, {"pins": {"a": 1}}, [], changed(pixel=[200, 0]), changed(pixel=[1]),
        changed(pixel=[-1, 0]), changed(color=8), changed(color=1), changed(camera={"fx": 1}), changed(camera=None),
        changed(pixel=["a", "b"]), changed(color=1e400),
    ],
)  # fmt: skip
def test_invalid_pins_are_refused(session: Any) -> None:
    with pytest.raises(UserError, match="the checkpoint's pinned rays"):
        restored_pins({"session": session})


def test_pins_beyond_the_number_of_colours_are_dropped() -> None:
    session = described(some(MOST_PINS))["session"]
    assert len(restored_pins({"session": {"pins": session["pins"] * 2}})) == MOST_PINS
