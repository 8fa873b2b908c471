"""What was watched comes back with a checkpoint and goes on; what nobody wrote is left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from desk import PATIENCE, Desk

from nerf_core.common.errors import UserError
from nerf_core.live.messages import LoadCheckpoint, Pin, Reset, SaveCheckpoint, Snapshot, Train, Unpin
from nerf_core.live.pin_files import restored
from nerf_core.probe import RayHistory
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings

OpenDesk = Callable[..., Desk]
pytestmark = pytest.mark.xdist_group("pin files")  # one worker trains what they all load


def history_of(snapshot: Snapshot, number: int = 1) -> RayHistory:
    found = next(pin.history for pin in snapshot.pinned if pin.id == number)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def saved(tiny: RunSettings, capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Snapshot]:
    """A checkpoint of step 5 with a ray pinned at step 0 and one pinned at step 3, and what was shown then."""
    desk, file = Desk(tiny, capture), tmp_path_factory.mktemp("saved") / "run.safetensors"
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(Pin(1, camera, (8, 8)), Train(3))
    desk.until(lambda s: s.step == 3 and s.status == "paused")
    desk.send(Pin(2, camera, (2, 2)), Train(2))
    shown = desk.until(
        lambda s: s.step == 5 and s.status == "paused" and len(s.pinned) == 2 and history_of(s).steps[-1] == 5
    )
    desk.send(SaveCheckpoint(file, {"mark": 7}))
    desk.until_told("saved step 5")
    assert desk.worker.stop(PATIENCE)
    return file, shown


def same(a: RayHistory, b: RayHistory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in vars(a))


def test_curves_and_maps_go_on_where_the_checkpoint_left_them(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot]
) -> None:
    (file, before), desk = saved, open_desk()
    assert before.scene is not None
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(LoadCheckpoint(file), Pin(7, camera, (8, 8)), Pin(8, camera, (2, 2)), Pin(9, camera, (5, 5)))
    loaded = desk.until(lambda s: len(s.pinned) == 3 and all(pin.history is not None for pin in s.pinned))
    assert same(history_of(loaded, 7), history_of(before, 1))
    assert same(history_of(loaded, 8), history_of(before, 2))
    assert history_of(loaded, 9).steps.tolist() == [5]
    np.testing.assert_array_equal(loaded.history.step, before.history.step)
    np.testing.assert_array_equal(loaded.history.loss, before.history.loss)

    later = desk.trained(3)
    assert later.history.step.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    later = desk.until(lambda s: history_of(s, 7).steps[-1] == 8)
    assert history_of(later, 7).steps.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert history_of(later, 8).steps.tolist() == [3, 4, 5, 6, 7, 8]


def test_what_is_removed_or_pinned_twice_begins_anew(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    desk, pixel = open_desk(), (2, 2)  # the ray that was pinned at step 3
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(LoadCheckpoint(saved[0]), Pin(1, camera, pixel), Pin(2, camera, pixel))
    both = desk.until(lambda s: len(s.pinned) == 2 and all(pin.history is not None for pin in s.pinned))
    assert history_of(both, 1).steps.tolist() == [3, 4, 5]
    assert history_of(both, 2).steps.tolist() == [5]
    desk.send(Unpin(1), Unpin(2), Pin(3, camera, pixel))
    again = desk.until(lambda s: [pin.id for pin in s.pinned] == [3] and s.pinned[0].history is not None)
    assert history_of(again, 3).steps.tolist() == [5]


def test_a_history_goes_on_at_the_step_where_its_ray_is_pinned_again(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot]
) -> None:
    desk = open_desk(steps=20_000)  # the checkpoint's own schedule, of 100 steps, counts
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(LoadCheckpoint(saved[0]), Train(120))  # past that schedule
    desk.until(lambda s: s.step == 125 and s.status != "training")
    desk.send(Pin(3, camera, (2, 2)))
    shown = desk.until(lambda s: len(s.pinned) == 1 and s.pinned[0].history is not None)
    assert history_of(shown, 3).steps.tolist() == [3, 4, 5, 125]


def test_another_training_knows_nothing_of_it(open_desk: OpenDesk, saved: tuple[Path, Snapshot]) -> None:
    desk = open_desk()
    camera = desk.until(lambda s: s.scene is not None).scene.views[0].camera  # pyright: ignore
    desk.send(LoadCheckpoint(saved[0]), Reset(), Pin(5, camera, (2, 2)))
    begun = desk.until(lambda s: len(s.pinned) == 1 and s.pinned[0].history is not None)
    assert history_of(begun, 5).steps.tolist() == [0]
    assert len(begun.history.step) == 0


def test_whoever_hears_that_a_checkpoint_was_loaded_finds_it_there(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot]
) -> None:
    desk = open_desk()
    desk.send(LoadCheckpoint(saved[0]))
    desk.until_told("loaded run.safetensors")
    shown = desk.worker.snapshot()
    assert shown.session == {"mark": 7}
    assert shown.step == 5
    assert shown.history.step.tolist() == [1, 2, 3, 4, 5]


def test_a_checkpoint_without_histories_has_none(saved: tuple[Path, Snapshot]) -> None:
    description, state = checkpoint.load(saved[0])
    assert len(restored(description, state)) == 2
    del description["watched"]
    assert not restored(description, state)


def bad(name: str, change: Callable[[torch.Tensor], Any]) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    def break_it(description: dict[str, Any], state: dict[str, Any]) -> None:
        state[f"watched.{name}"] = change(state[f"watched.{name}"])

    return break_it


def told(rays: object) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda description, state: description.update(watched=rays)


BROKEN = {
    "a missing tensor": lambda description, state: state.pop("watched.1.weights"),
    "rays that are numbers": told([1]),
    "a ray without a camera": told([{"pixel": [1, 1]}]),
    "a number": told(3),
    "more rays than anybody pins": lambda description, state: description.update(watched=description["watched"] * 40),
    "a step that was never made": bad("0.steps", lambda v: v + 1),
    "steps that go back": bad("0.steps", lambda v: v.flip(0)),
    "steps that are fractions": bad("0.steps", lambda v: v.double()),
    "a step before the first": bad("0.steps", lambda v: v - 1),
    "another length": bad("0.depth", lambda v: v[1:]),
    "no records": bad("1.steps", lambda v: v[:0]),
    "a weight that is no number": bad("0.weights", lambda v: v * torch.nan),
    "weights of another kind": bad("0.weights", lambda v: v.long()),
    "more bins": bad("0.weights", lambda v: torch.cat([v, v], 1)),
    "edges that do not rise": bad("1.edges", lambda v: v.flip(0)),
    "an infinite depth": bad("0.depth", lambda v: v + torch.inf),
}


def test_histories_that_nobody_wrote_are_refused(saved: tuple[Path, Snapshot]) -> None:
    for what, break_it in BROKEN.items():
        description, state = checkpoint.load(saved[0])
        break_it(description, state)
        with pytest.raises(UserError, match="histories cannot be read"):
            pytest.fail(f"{what} is taken: {restored(description, state)}")


def test_a_model_opens_without_the_histories_that_are_refused(
    open_desk: OpenDesk, saved: tuple[Path, Snapshot], tmp_path: Path
) -> None:
    file = tmp_path / "run.safetensors"
    description, state = checkpoint.load(saved[0])
    checkpoint.save(file, description | {"watched": 5}, state)
    desk = open_desk()
    desk.send(LoadCheckpoint(file))
    assert desk.until_told("the checkpoint's pinned rays' histories cannot be read: they begin anew").level == "warning"
    assert desk.worker.snapshot().step == 5  # what is told is published before
    assert desk.trained(1).history.step.tolist() == [1, 2, 3, 4, 5, 6]
