"""Pinned rays: as the window keeps them, and as a checkpoint does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nerf_core.common.errors import UserError
from nerf_core.datasets.formats.demo import LANDMARKS
from nerf_core.geometry.camera_files import camera_of, camera_values
from nerf_core.live.messages import Inspect

from .state import PinnedRay

MOST = 8  # colours that can be told apart
NAME_LENGTH = 60


def new_pin(pins: list[PinnedRay], ray: Inspect) -> PinnedRay:
    """The next one, in a colour that no other has. Raises UserError when there are MOST."""
    if len(pins) >= MOST:
        raise UserError(f"{MOST} rays are pinned already: remove one first")
    number = max((pin.id for pin in pins), default=0) + 1
    free = next(k for k in range(MOST) if k not in {pin.color for pin in pins})
    return PinnedRay(number, f"ray {number}", free, ray)


def spare(pins: list[PinnedRay]) -> list[PinnedRay]:
    """The demo's own that are still out of sight, the last first: they give way to those that somebody asks for."""
    names = {name for name, _, _ in LANDMARKS}
    return [pin for pin in reversed(pins) if pin.hidden and pin.name in names]


def to_json(pins: list[PinnedRay]) -> dict[str, Any]:
    """What a checkpoint keeps; nothing where nothing is pinned."""
    if not pins:
        return {}
    return {
        "pins": [
            {
                "name": pin.name, "color": pin.color, "hidden": pin.hidden, "pixel": list(pin.ray.pixel),
                "camera": camera_values(pin.ray.camera),
            }
            for pin in pins
        ]
    }  # fmt: skip


def from_json(session: Mapping[str, Any]) -> list[PinnedRay]:
    """The pins of `to_json`. Raises UserError for what it did not write: a checkpoint comes from anywhere."""
    try:
        stored = session.get("pins", [])
        pins = [_pin(number, values) for number, values in enumerate(stored[:MOST], 1)]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError("the checkpoint's pinned rays cannot be read: they are left out") from None
    if len({pin.color for pin in pins}) < len(pins):
        raise UserError("the checkpoint's pinned rays share a colour: they are left out")
    return pins


def _pin(number: int, values: Mapping[str, Any]) -> PinnedRay:
    camera, (column, row) = camera_of(values["camera"]), (int(v) for v in values["pixel"])
    color = int(values["color"])
    if not (0 <= column < camera.width and 0 <= row < camera.height and 0 <= color < MOST):
        raise ValueError("not of the kind that is written")
    name = "".join(c for c in str(values["name"]) if c.isprintable())[:NAME_LENGTH]
    return PinnedRay(number, name, color, Inspect(camera, (column, row)), bool(values["hidden"]))
