"""How pinned rays came to be, as a checkpoint keeps it beside the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera_files import camera_of, camera_values
from nerf_core.live.messages import Inspect
from nerf_core.probe import RayHistory
from nerf_core.probe.history import BINS

Watched = Sequence[tuple[Inspect, RayHistory]]
FIELD = "watched"  # of the description: the rays
MOST_RAYS, MOST_RECORDS = 64, 5000  # a schedule makes some 280 records of a ray; twice its steps, some 30 more
N = -1  # records
SHAPES = {"edges": (BINS + 1,), "steps": (N,), "weights": (N, BINS), "color": (N, 3), "depth": (N,), "opacity": (N,)}


def described(watched: Watched) -> dict[str, Any]:
    """What a checkpoint's description holds of it, as JSON values."""
    return {FIELD: [{"camera": camera_values(ray.camera), "pixel": list(ray.pixel)} for ray, _ in watched]}


def state(watched: Watched) -> dict[str, Tensor]:
    """What a checkpoint's tensors are of it, by name."""
    return {
        f"{FIELD}.{k}.{f.name}": torch.from_numpy(np.array(getattr(history, f.name)))
        for k, (_, history) in enumerate(watched)
        for f in fields(RayHistory)
    }


def restored(description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Watched:
    """What `described()` and `state()` hold of a run at its step; nothing of checkpoints that have none.

    Raises UserError for what those did not write: a checkpoint comes from anywhere.
    """
    found = []
    try:
        rays = description.get(FIELD, ())
        if len(rays) > MOST_RAYS:
            raise ValueError("more than anybody pins")
        for k, values in enumerate(rays):
            camera, (column, row) = camera_of(values["camera"]), (int(v) for v in values["pixel"])
            arrays = {name: tensors[f"{FIELD}.{k}.{name}"].numpy() for name in SHAPES}
            found.append((Inspect(camera, (column, row)), _history(arrays, description["step"])))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError("the checkpoint's pinned rays' histories cannot be read: they begin anew") from None
    return found


def _history(arrays: Mapping[str, np.ndarray], last: int) -> RayHistory:
    """Of steps until `last`."""
    count = len(arrays["steps"])
    shapes = {name: tuple(count if n == N else n for n in shape) for name, shape in SHAPES.items()}
    if {name: value.shape for name, value in arrays.items()} != shapes or not 0 < count <= MOST_RECORDS:
        raise ValueError("not the shapes of a history")
    if any(value.dtype.kind != ("i" if name == "steps" else "f") for name, value in arrays.items()):
        raise ValueError("not the types of a history")
    numbers = all(np.isfinite(arrays[name]).all() for name in ("edges", "weights", "color", "opacity"))
    steps = np.concatenate([[-1], arrays["steps"], [last + 1]])
    if not (numbers and (np.diff(arrays["edges"]) > 0).all() and (np.diff(steps) > 0).all()):
        raise ValueError("not the numbers of a history")
    if np.isinf(arrays["depth"]).any():
        raise ValueError("not the depths of a history")
    return RayHistory(**arrays)
