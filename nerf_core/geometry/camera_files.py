"""Write cameras as JSON values, read them back, and find the camera that a command line names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.json_files import read_json
from nerf_core.common.names import printable
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import KINDS, Lens
from nerf_core.geometry.scene import Scene

MOST_PIXELS = 1 << 16  # on one side of a picture
# No real camera has numbers beyond these limits, and float32 rays would overflow
FARTHEST = 1e9  # from the origin, in units of the world; principal points, in pixels
FOCAL = 1e-3, 1e9  # pixels
LENS = 1e6  # its coefficients
LATER = "k4", "k5", "k6"  # written only where they are not 0, so that the files of other lenses stay as they were
NEEDED = "width", "height", "fx", "fy", "cx", "cy", "c2w"
CAMERA_FILE = f'an object as an opened ray\'s file has under "camera" ({", ".join(NEEDED)}: 3 × 4)'


def camera_values(camera: Camera) -> dict[str, Any]:
    """Return every field of a camera under its name, c2w as nested lists."""
    values = asdict(camera)
    lens = values.pop("lens")
    kind = KINDS[int(lens.pop("kind"))]
    later = {name: value for name in LATER if (value := lens.pop(name))}
    if kind != KINDS[0]:
        later["lens"] = kind
    return {**values, "c2w": camera.c2w.tolist(), **lens, **later}


def camera_of(values: Mapping[str, Any]) -> Camera:
    """Rebuild the camera from `camera_values`. Raises ValueError, TypeError or OverflowError for anything else."""
    if not isinstance(values, Mapping):
        raise TypeError(f"{shorten(values)} is not an object")
    for name in NEEDED:
        if name not in values:
            raise ValueError(f"field {name} is missing")
    width, height = _number(values, "width"), _number(values, "height")
    fx, fy, cx, cy = (_number(values, name) for name in ("fx", "fy", "cx", "cy"))
    lens = {f.name: _number(values, f.name) for f in fields(Lens) if f.name != "kind"}
    kind = values.get("lens", KINDS[0])
    if kind not in KINDS:
        raise ValueError(f"lens is {shorten(kind)}: {', '.join(KINDS)} are known")
    if not all(0 < side <= MOST_PIXELS and side.is_integer() for side in (width, height)):
        raise ValueError(f"a picture of {width:g} × {height:g} pixels")
    if not (FOCAL[0] <= fx <= FOCAL[1] and FOCAL[0] <= fy <= FOCAL[1]):
        raise ValueError(f"fx and fy must lie between {FOCAL[0]:g} and {FOCAL[1]:g}")
    for name, value, most in (("cx", cx, FARTHEST), ("cy", cy, FARTHEST), *((k, v, LENS) for k, v in lens.items())):
        if not abs(value) <= most:
            raise ValueError(f"{name} must lie between ±{most:g}")
    try:
        c2w = np.array(values["c2w"], np.float64)
    except (ValueError, TypeError, OverflowError):
        c2w = np.zeros(0)
    if c2w.shape != (3, 4) or not (np.abs(c2w) <= FARTHEST).all():
        raise ValueError(f"c2w must be 3 × 4 numbers between ±{FARTHEST:g}")
    if not (np.allclose(c2w[:, :3] @ c2w[:, :3].T, np.eye(3), atol=1e-4) and np.linalg.det(c2w[:, :3]) > 0):
        raise ValueError("the first three columns of c2w must be a rotation")
    return Camera(int(width), int(height), fx, fy, cx, cy, c2w, Lens(**lens, kind=KINDS.index(kind)))


def _number(values: Mapping[str, Any], name: str) -> float:
    """One field as a number; a missing lens coefficient is 0."""
    value = values.get(name, 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} is {shorten(value)}: a number is needed")
    return float(value)


def picked_camera(scene: Scene, text: str) -> Camera:
    """Return the camera that a command line option names.

    Args:
        scene: the open scene.
        text: the name of a photo or the end of its name, or a .json file with a camera, such as an opened ray's file.

    Raises:
        UserError: if no camera or more than one fits.
    """
    if text.lower().endswith(".json"):
        values = read_json(Path(text), CAMERA_FILE).values
        if isinstance(rays := values.get("rays"), list) and rays and isinstance(rays[0], Mapping):
            values = rays[0]  # in a file of several rays the opened one comes before the pinned ones
        try:
            return camera_of(values.get("camera", values))
        except (TypeError, ValueError, OverflowError) as error:
            what = f"holds no camera ({str(error)[:80]})"
            raise UserError(f"--camera {shorten(text, 300)}: {what}: {CAMERA_FILE} is needed") from None
    text = printable(text)  # as the names of views are
    exact = [view for view in scene.views if view.name == text]
    found = exact or [
        view for view in scene.views if Path(view.name).stem in (Path(text).stem, Path(text).name) and text in view.name
    ]
    if len(found) == 1:
        return found[0].camera
    named = [shorten(view.name) for view in found or scene.views]
    some = ", ".join(named[:3]) + (", …" if len(named) > 3 else "")
    what = f"means {len(found)} photos" if found else f"is none of the {len(scene.views):,} photos"
    raise UserError(f"--camera {shorten(text, 300)}: {what} ({some}): give a photo's whole name or a .json file")
