"""Pinned rays: by hand, through the panel, and through a checkpoint."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from panel_states import make_camera

from nerf_core.common.errors import UserError
from nerf_core.live.messages import Inspect
from viewer.model.pins import MOST, from_json, new_pin, to_json
from viewer.model.state import PinnedRay


def some(count: int) -> list[PinnedRay]:
    pins: list[PinnedRay] = []
    for k in range(count):
        pins.append(new_pin(pins, Inspect(make_camera(np.array([3.0, 1.0, 1.0 + k])), (k, 2 * k))))
    return pins


def test_every_pin_has_a_colour_of_its_own_and_there_are_so_many() -> None:
    pins = some(MOST)
    assert {pin.color for pin in pins} == set(range(MOST))
    with pytest.raises(UserError, match="8 rays are pinned already: remove one first"):
        new_pin(pins, pins[0].ray)
    left = [pin for pin in pins if pin.color != 3]
    again = new_pin(left, pins[0].ray)
    assert again.color == 3
    assert again.id not in {pin.id for pin in left}


def test_pins_come_back_from_a_checkpoint() -> None:
    pins = some(3)
    pins[1].name, pins[1].hidden = "the rim\u202e of it\n", True
    again = from_json(json.loads(json.dumps(to_json(pins))))
    assert [pin.name for pin in again] == ["ray 1", "the rim of it", "ray 3"]  # no signs that turn or break a line
    assert [(pin.color, pin.hidden, pin.ray.pixel) for pin in again] == [
        (pin.color, pin.hidden, pin.ray.pixel) for pin in pins
    ]
    for a, b in zip(again, pins, strict=True):
        np.testing.assert_array_equal(a.ray.camera.c2w, b.ray.camera.c2w)
        assert a.ray.camera.intrinsics() == b.ray.camera.intrinsics()
    assert from_json({}) == []


def changed(**values: Any) -> dict[str, Any]:
    session = to_json(some(2))
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
def test_what_no_window_wrote_is_left_out(session: Any) -> None:
    with pytest.raises(UserError, match="the checkpoint's pinned rays"):
        from_json(session)
