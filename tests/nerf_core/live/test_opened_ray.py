"""Rays that the worker keeps open: inspected and pinned ones, their histories and files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from desk import Desk

from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import (
    ExportRays,
    Inspect,
    PinRay,
    Reset,
    Snapshot,
    Train,
    UnpinRay,
    UseMethod,
    ViewRequest,
)
from nerf_core.live.opened_ray import OpenedRay
from nerf_core.live.pins import Pins
from nerf_core.probe import open_pixel
from nerf_core.probe.history import BINS

OpenDesk = Callable[..., Desk]


def scene_of(desk: Desk) -> Scene:
    scene = desk.worker.snapshot().scene
    assert scene is not None
    return scene


def records(snapshot: Snapshot, number: int = 1) -> list[int]:
    for pin in snapshot.pins:
        if pin.id == number and pin.history is not None:
            return pin.history.steps.tolist()
    return []


def test_a_pinned_ray_has_a_history_from_the_step_it_was_pinned_at(open_desk: OpenDesk) -> None:
    desk = open_desk()
    camera = scene_of(desk).views[0].camera
    desk.send(PinRay(camera, (8, 8), id=1), Train(5))
    desk.until(lambda s: s.step == 5 and s.status == "paused")
    desk.send(PinRay(camera, (2, 2), id=2), Train(4))
    shown = desk.until(lambda s: s.step == 9 and s.status == "paused" and records(s)[-1:] == [9])
    assert records(shown) == list(range(10))  # a schedule of 100 steps records every step
    assert records(shown, 2) == [5, 6, 7, 8, 9]
    first = shown.pins[0]
    assert first.ray is not None
    assert first.history is not None
    np.testing.assert_allclose(first.history.color[-1], first.ray.color)
    assert first.history.weights.shape == (10, BINS)
    desk.send(UnpinRay(1))
    assert [pin.id for pin in desk.until(lambda s: len(s.pins) == 1).pins] == [2]


def test_a_reset_or_another_method_begins_a_new_history(open_desk: OpenDesk) -> None:
    desk = open_desk()
    desk.send(PinRay(scene_of(desk).views[0].camera, (8, 8), id=1), Train(3))
    desk.until(lambda s: records(s) == [0, 1, 2, 3])
    desk.send(Reset())
    assert records(desk.until(lambda s: s.step == 0)) == [0]
    desk.send(Train(2), UseMethod("voxels"))
    assert records(desk.until(lambda s: s.method == "voxels")) == [0]


def test_a_pin_that_cannot_be_opened_is_reported_once_and_the_others_stay(open_desk: OpenDesk) -> None:
    desk = open_desk()
    camera = scene_of(desk).views[0].camera
    desk.send(PinRay(camera, (99, 0), id=1), PinRay(camera, (3, 3), id=2))
    desk.until_told("pixel 99 0: outside the picture")
    shown = desk.until(lambda s: len(s.pins) == 1 and s.pins[0].ray is not None)
    assert shown.pins[0].id == 2
    desk.trained(2)
    assert sum("pixel 99" in notice.text for notice in desk.heard) == 1


def test_all_parts_of_an_opened_ray_reach_the_same_step(open_desk: OpenDesk) -> None:
    desk = open_desk()
    scene, camera = scene_of(desk), scene_of(desk).views[2].camera
    desk.trained(3)
    desk.send(Inspect(camera, (7, 9)))
    opened = desk.until(lambda s: s.opened_step == 3).opened
    assert opened is not None
    assert opened.verdict is not None
    assert opened.radiance is not None
    assert opened.evidence is not None
    assert opened.ray.step == opened.radiance.step == 3
    assert opened.walk[0].title == "Camera and pixel"
    assert opened.walk[-1].title == "Loss"  # there is a photo from here
    assert scene.images[2][9, 7].tolist() == pytest.approx((65535 * _photo(opened.walk[-2].charts[0].rgb)).tolist())  # pyright: ignore


def _photo(colors: np.ndarray) -> np.ndarray:
    return colors[1]


def test_what_the_window_shows_is_what_a_notebook_opens(open_desk: OpenDesk, tmp_path: Path) -> None:
    """The worker's file and the library have the same arrays for the same weights."""
    desk = open_desk()
    camera = scene_of(desk).views[1].camera
    desk.trained(4)
    desk.send(Inspect(camera, (8, 8)))
    desk.until(lambda s: s.opened_step == 4)
    desk.send(ExportRays(tmp_path / "ray.json"), PinRay(camera, (3, 3)), ExportRays(tmp_path / "rays.json"))
    desk.until_told("rays.json")
    trainer = desk.worker._runs[1].trainer
    assert trainer is not None
    again = open_pixel(trainer.method, trainer.scene, camera, (8, 8), 4)
    stored = json.loads((tmp_path / "ray.json").read_text())
    np.testing.assert_allclose(stored["passes"][-1]["weights"], again.ray.passes[-1].weights, atol=1e-6)
    assert again.radiance is not None
    np.testing.assert_allclose(stored["radiance"]["rgb"], again.radiance.rgb, atol=1e-6)
    both = json.loads((tmp_path / "rays.json").read_text())["rays"]
    assert [one["pixel"] for one in both] == [[8, 8], [3, 3]]
    desk.send(ExportRays(tmp_path / "rays.txt"))
    desk.until_told("an opened ray is written as")


def test_a_dragged_point_moves_at_once(open_desk: OpenDesk) -> None:
    """The first piece of work moves it. The ray's other results stay as they were until they are computed again."""
    desk = open_desk()
    scene, camera = scene_of(desk), scene_of(desk).views[2].camera
    desk.trained(2)
    assert desk.worker.stop()
    trainer, rays = desk.worker._runs[1].trainer, OpenedRay()
    assert trainer is not None
    asked = Inspect(camera, (7, 9))
    rays.inspect(asked)
    while rays.draw(trainer, True):
        pass
    whole = rays.opened
    assert whole is not None
    for t in (2.5, 3.25):
        rays.inspect(asked.again(point_t=t))
        assert rays.draw(trainer, True)
        assert rays.opened is not None
        assert rays.opened.radiance is not None
        assert rays.opened.radiance.t == t
        assert rays.opened.verdict is whole.verdict
        assert rays.opened.walk is whole.walk
        assert rays.opened_step == -1
    while rays.draw(trainer, True):
        pass
    again = open_pixel(trainer.method, scene, camera, (7, 9), 2, 3.25)
    assert rays.opened is not None
    assert rays.opened.verdict is not None
    assert again.verdict is not None
    assert rays.opened_step == 2
    assert rays.opened.verdict.reasons == again.verdict.reasons


def test_every_ray_is_written_complete_and_once(open_desk: OpenDesk) -> None:
    """A ray whose results are still being computed is written complete. One that is also pinned is written once."""
    desk = open_desk()
    camera = scene_of(desk).views[2].camera
    desk.trained(2)
    assert desk.worker.stop()
    trainer, rays = desk.worker._runs[1].trainer, OpenedRay()
    assert trainer is not None
    pins, asked = Pins(), Inspect(camera, (7, 9), 2.5)
    for name, pixel, number in (("a", (3, 3), 1001), ("b", (7, 9), asked.id), ("c", (5, 5), 1002)):
        pins.add(PinRay(replace(camera), pixel, name, id=number), trainer)
    pins.record(trainer)
    rays.inspect(asked)
    for _ in range(3):  # not begun, then half done
        written = rays.whole(trainer, list(pins)[:2])
        assert [(one.ray.pixel, one.name) for one in written] == [((7, 9), "b"), ((3, 3), "a")]
        assert all(one.history is not None and one.history.steps.tolist() == [2] for one in written)
        assert all(one.verdict is not None and one.evidence is not None and one.walk for one in written)
        assert written[0].radiance is not None
        assert written[0].radiance.t == 2.5
        assert rays.draw(trainer, True)
    while rays.draw(trainer, True):
        pass
    assert rays.whole(trainer, [])[0] is rays.opened


def test_every_request_to_inspect_is_answered_by_its_number(open_desk: OpenDesk) -> None:
    desk = open_desk()
    first = Inspect(scene_of(desk).views[0].camera, (7, 9))
    again = first.again(point_t=2.5)
    assert again.id == first.id != Inspect(first.camera, first.pixel).id
    desk.trained(2)
    for look in (first, again):
        desk.send(look)
        shown = desk.until(lambda s, look=look: s.opened_look == look.look)
        assert shown.opened_id == first.id
        assert shown.opened_step == 2
    assert shown.radiance is not None
    assert shown.radiance.t == 2.5


def test_a_mode_is_drawn_in_its_colours(open_desk: OpenDesk) -> None:
    desk = open_desk()
    desk.trained(3)
    camera = scene_of(desk).views[0].camera
    desk.worker.request_view(ViewRequest(1, camera, False))
    plain = desk.until(lambda s: s.preview is not None and s.preview.stamp == 1 and s.preview.complete).preview
    desk.worker.request_view(ViewRequest(2, camera, False, "view-dependence"))
    shown = desk.until(lambda s: s.preview is not None and s.preview.stamp == 2 and s.preview.complete).preview
    assert plain is not None
    assert shown is not None
    assert (plain.mode, shown.mode) == ("colour", "view-dependence")
    assert not np.array_equal(plain.rgba, shown.rgba)
    np.testing.assert_array_equal(plain.depth, shown.depth)


def test_nothing_of_the_model_before_is_shown_as_the_new_ones(open_desk: OpenDesk, plain_methods: None) -> None:
    desk = open_desk()
    asked = Inspect(scene_of(desk).views[0].camera, (8, 8))
    desk.send(asked)
    before = desk.until(lambda s: s.opened_look == asked.look)
    assert before.opened is not None
    assert before.opened.radiance is not None
    desk.send(UseMethod("sampled"))
    after = desk.until(lambda s: s.method == "sampled" and s.opened_step == 0)
    assert after.opened is not None
    assert after.opened.method == "sampled"
    assert after.opened.walk
    assert after.opened.radiance is None


def test_a_method_without_samples_leaves_the_pins_alone(open_desk: OpenDesk, plain_methods: None) -> None:
    desk = open_desk()
    camera = scene_of(desk).views[0].camera
    desk.send(PinRay(camera, (8, 8), id=1), UseMethod("plain", train=True))
    desk.until(lambda s: s.method == "plain" and s.step > 2)
    desk.send(UseMethod("nerf"))
    shown = desk.until(lambda s: s.method == "nerf" and s.pins[0].ray is not None)
    assert [pin.id for pin in shown.pins] == [1]
    assert not [notice for notice in desk.heard if notice.level == "error"]
