"""The worker's pinned rays: their colours, names and number, and which of them give way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from nerf_core.common.errors import UserError
from nerf_core.live.messages import MOST_PINS, EditPin, PinRay
from nerf_core.live.pins import Pins
from nerf_core.training.trainer import Trainer


@pytest.fixture
def trainer(make_trainer: Callable[..., Trainer]) -> Trainer:
    return make_trainer()


def pin(trainer: Trainer, k: int = 0, name: str = "", hidden: bool = False) -> PinRay:
    return PinRay(trainer.scene.views[0].camera, (k, k), name, hidden)


def test_every_pin_has_its_own_colour_and_their_number_is_limited(trainer: Trainer) -> None:
    pins = Pins()
    for k in range(MOST_PINS):
        pins.add(pin(trainer, k), trainer)
    assert {pin.color for pin in pins} == set(range(MOST_PINS))
    assert [pin.name for pin in pins] == [f"ray {k + 1}" for k in range(MOST_PINS)]
    with pytest.raises(UserError, match="8 rays are pinned already: remove one first"):
        pins.add(pin(trainer), trainer)
    pins.remove(next(pin.id for pin in pins if pin.color == 3))
    pins.add(pin(trainer), trainer)
    last = list(pins)[-1]
    assert (last.color, last.name) == (3, "ray 9")


def test_a_ray_is_pinned_once(trainer: Trainer) -> None:
    pins, wanted = Pins(), pin(trainer)
    pins.add(wanted, trainer)
    pins.add(wanted, trainer)
    assert [pin.id for pin in pins] == [wanted.id]


def test_names_are_changed_and_cut(trainer: Trainer) -> None:
    pins, wanted = Pins(), pin(trainer)
    pins.add(wanted, trainer)
    pins.edit(EditPin(wanted.id, name="x" * 99))
    pins.edit(EditPin(wanted.id, hidden=True))
    pins.edit(EditPin(-1, name="nobody"))
    (found,) = pins
    assert (found.name, found.hidden) == ("x" * 60, True)


def test_the_scenes_hidden_pins_give_way(trainer: Trainer) -> None:
    landmarks = (("glossy ball", 0.5, 0.5), ("vase", 0.5, 0.5), ("past the ball", 0.5, 0.5))
    trainer.scene = replace(trainer.scene, landmarks=landmarks)
    pins = Pins()
    for name, hidden in (("vase", True), ("glossy ball", False), ("past the ball", True)):
        pins.add(pin(trainer, name=name, hidden=hidden), trainer)
    for _ in range(7):
        pins.add(pin(trainer), trainer)
    assert [pin.name for pin in pins] == ["glossy ball", *(f"ray {k}" for k in range(1, 8))]
    with pytest.raises(UserError, match="8 rays are pinned already"):
        pins.add(pin(trainer), trainer)


def test_a_restored_pin_keeps_its_number_to_itself(trainer: Trainer) -> None:
    pins = Pins()
    for name in ("", "ray 5", "ray of hope", ""):
        pins.add(pin(trainer, name=name), trainer)
    assert [pin.name for pin in pins] == ["ray 1", "ray 5", "ray of hope", "ray 6"]
    again = Pins()
    again.replace(list(pins)[1:3], trainer)
    again.add(pin(trainer), trainer)
    assert [pin.name for pin in again] == ["ray 5", "ray of hope", "ray 6"]
