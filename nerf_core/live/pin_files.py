"""Pinned rays as a checkpoint keeps them beside the model: two parts of its description, and tensors.

`session.pins` has names, colours and places. `watched` has the rays with a history, whose arrays are tensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.common.names import printable
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.camera_files import camera_of, camera_values
from nerf_core.live.messages import MOST_PINS, PIN_NAME_LENGTH, Inspect, Pin, PinRay
from nerf_core.methods import lacking
from nerf_core.probe import RayHistory
from nerf_core.probe.history import BINS

T = TypeVar("T")
D = TypeVar("D")
FIELD = "watched"
MOST_RAYS, MOST_RECORDS = (
    64,
    5000,
)  # a schedule of 30,000 steps makes some 400 records of a ray; twice its steps, some 40 more
N = -1  # records
SHAPES = {"edges": (BINS + 1,), "steps": (N,), "weights": (N, BINS), "color": (N, 3), "depth": (N,), "opacity": (N,)}


def described(pins: Sequence[Pin]) -> dict[str, Any]:
    """Return what a checkpoint's description holds of pins, as JSON values."""
    session = [
        {
            "name": pin.name, "color": pin.color, "hidden": pin.hidden, "pixel": list(pin.pixel),
            "camera": camera_values(pin.camera),
        }
        for pin in pins
    ]  # fmt: skip
    watched = [{"camera": camera_values(pin.camera), "pixel": list(pin.pixel)} for pin in _watched(pins)]
    return {"session": {"pins": session} if session else {}, FIELD: watched}


def tensors(pins: Sequence[Pin]) -> dict[str, Tensor]:
    """Return what a checkpoint's tensors hold of pins, by name."""
    return {
        f"{FIELD}.{k}.{f.name}": torch.from_numpy(np.array(getattr(pin.history, f.name)))
        for k, pin in enumerate(_watched(pins))
        for f in fields(RayHistory)
    }


def restored_pins(description: Mapping[str, Any], open_rays: Iterable[Pin | Inspect] = ()) -> list[Pin]:
    """Return the pins of a description, without histories. A checkpoint may have none.

    open_rays: rays that are open already. A pin of the same camera and pixel gets the id of the open ray.

    Raises UserError for what `described` did not write: a checkpoint comes from anywhere.
    """
    try:
        stored = description.get("session", {}).get("pins", [])
        pins = [_pin(values) for values in stored[:MOST_PINS]]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError("the checkpoint's pinned rays cannot be read: they are left out") from None
    if len({pin.color for pin in pins}) < len(pins):
        raise UserError("the checkpoint's pinned rays share a colour: they are left out")
    places = {ray.id: _place(ray.camera, ray.pixel) for ray in open_rays}  # a pin may be the opened ray too
    known = [(place, number) for number, place in places.items()]
    return [replace(pin, id=_take(known, _place(pin.camera, pin.pixel), pin.id)) for pin in pins]


def with_histories(pins: Iterable[Pin], description: Mapping[str, Any], state: Mapping[str, Tensor]) -> list[Pin]:
    """Return `pins` with the histories that `described` and `tensors` hold of the same rays.

    Raises UserError for what those did not write.
    """
    try:
        found = list(_histories(description, state))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError("the checkpoint's pinned rays' histories cannot be read: they begin anew") from None
    return [replace(pin, history=_take(found, _place(pin.camera, pin.pixel), None)) for pin in pins]


def _place(camera: Camera, pixel: tuple[int, int]) -> Any:
    """Return what tells rays apart. JSON keeps every digit, so the same ray has the same numbers in every file."""
    return camera_values(camera), list(pixel)


def _take(found: list[tuple[Any, T]], place: Any, default: D) -> T | D:
    """Remove and return the first value of this place; `default` if there is none."""
    k = next((k for k, (where, _) in enumerate(found) if where == place), None)
    return default if k is None else found.pop(k)[1]


def _watched(pins: Sequence[Pin]) -> list[Pin]:
    return [pin for pin in pins if pin.history is not None]


def _pin(values: Mapping[str, Any]) -> Pin:
    camera, (column, row) = camera_of(values["camera"]), (int(v) for v in values["pixel"])
    color = int(values["color"])
    if not (0 <= column < camera.width and 0 <= row < camera.height and 0 <= color < MOST_PINS):
        raise ValueError("not of the kind that is written")
    name = printable(str(values["name"]))[:PIN_NAME_LENGTH]
    return Pin(PinRay(camera, (column, row)).id, name, color, bool(values["hidden"]), camera, (column, row))


def _histories(description: Mapping[str, Any], state: Mapping[str, Tensor]) -> Iterable[tuple[Any, RayHistory]]:
    """Yield the camera values and the pixel of each watched ray, with its history."""
    rays = description.get(FIELD, ())
    if len(rays) > MOST_RAYS:
        raise ValueError("more than anybody pins")
    for k, values in enumerate(rays):
        camera, (column, row) = camera_of(values["camera"]), (int(v) for v in values["pixel"])
        arrays = {name: state[f"{FIELD}.{k}.{name}"].numpy() for name in SHAPES}
        weightless = bool(lacking(description["method"], "trace"))
        yield _place(camera, (column, row)), _history(arrays, description["step"], weightless)


def _history(arrays: Mapping[str, np.ndarray], last: int, weightless: bool) -> RayHistory:
    """Return a history of steps until `last`. Raises ValueError if the arrays are not those of a history.

    weightless: whether it is of a method without samples, whose weights are NaN.
    """
    count = len(arrays["steps"])
    shapes = {name: tuple(count if n == N else n for n in shape) for name, shape in SHAPES.items()}
    if {name: value.shape for name, value in arrays.items()} != shapes or not 0 < count <= MOST_RECORDS:
        raise ValueError("not the shapes of a history")
    if any(value.dtype.kind != ("i" if name == "steps" else "f") for name, value in arrays.items()):
        raise ValueError("not the types of a history")
    numbers = all(np.isfinite(arrays[name]).all() for name in ("edges", "color", "opacity"))
    numbers &= (np.isnan if weightless else np.isfinite)(arrays["weights"]).all()
    steps = np.concatenate([[-1], arrays["steps"], [last + 1]])
    if not (numbers and (np.diff(arrays["edges"]) > 0).all() and (np.diff(steps) > 0).all()):
        raise ValueError("not the numbers of a history")
    if np.isinf(arrays["depth"]).any():
        raise ValueError("not the depths of a history")
    return RayHistory(**arrays)
