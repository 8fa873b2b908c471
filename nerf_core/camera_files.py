"""Cameras as JSON values, and where a command line names one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.cameras import Camera
from nerf_core.datasets.json_reader import read_json
from nerf_core.errors import UserError, shorten
from nerf_core.scene import Scene

MOST_PIXELS = 1 << 16  # a side


def camera_values(camera: Camera) -> dict[str, Any]:
    """Every field by its name, c2w as lists."""
    return {**asdict(camera), "c2w": camera.c2w.tolist()}


def camera_of(values: Mapping[str, Any]) -> Camera:
    """The camera of `camera_values`. Raises ValueError, KeyError or TypeError for anything else."""
    c2w = np.array(values["c2w"], np.float64)
    width, height = int(values["width"]), int(values["height"])
    names = [f.name for f in fields(Camera) if f.name not in ("width", "height", "c2w")]
    lens = {name: float(values.get(name, 0.0) if name[0] in "kp" else values[name]) for name in names}
    if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
        raise ValueError(f"a picture of {width} × {height} pixels")
    if not np.isfinite(list(lens.values())).all() or min(lens["fx"], lens["fy"]) <= 0:
        raise ValueError("focal lengths above 0 and finite numbers are needed")
    if c2w.shape != (3, 4) or not np.isfinite(c2w).all():
        raise ValueError("c2w must be 3 × 4 numbers")
    if not np.allclose(c2w[:, :3] @ c2w[:, :3].T, np.eye(3), atol=1e-4):
        raise ValueError("the first three columns of c2w must be a rotation")
    return Camera(width, height, c2w=c2w, **lens)


def picked_camera(scene: Scene, text: str) -> Camera:
    """The camera that an option names: a photo of the scene, by its name or its end, or a .json file with a camera, as
    an opened ray's. Raises UserError."""
    if text.lower().endswith(".json"):
        values = read_json(Path(text)).values
        inner = values.get("camera", values)
        try:
            return camera_of(inner)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise UserError(
                f"--camera {text}: holds no camera ({shorten(str(error), 80)}): width, height, fx, fy, cx, cy and a "
                "3 × 4 c2w are needed"
            ) from None
    exact = [view for view in scene.views if view.name == text]
    found = exact or [view for view in scene.views if Path(view.name).stem == Path(text).stem and text in view.name]
    if len(found) == 1:
        return found[0].camera
    some = ", ".join(view.name for view in (found or scene.views)[:3])
    what = f"means {len(found)} photos" if found else f"is none of the {len(scene.views):,} photos"
    raise UserError(f"--camera {text}: {what} ({some}, …): give a photo's whole name or a .json file")
