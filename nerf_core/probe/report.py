"""Write opened pixels to files: JSON and NPZ hold everything, CSV the samples, PNG and SVG a figure."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.files import write_atomically
from nerf_core.common.json_files import finite
from nerf_core.geometry.camera_files import camera_values
from nerf_core.probe.axis import AxisChoice
from nerf_core.probe.records import WITHOUT_SAMPLES, Opened, PassProbe, RayProbe
from nerf_core.probe.standing import Verdict

SAMPLE = ("t", "until", "delta", "sigma", "alpha", "transmittance", "weights")
RADIANCE = (
    "point", "t", "directions", "rgb", "back_rgb", "dependence", "layer", "layer_rgb", "layer_back_rgb",
    "layer_dependence", "frozen_rgb", "axes", "normal",
)  # fmt: skip


def inspection(opened: Opened) -> dict[str, Any]:
    """Return everything about an opened pixel as JSON values.

    Arrays become nested lists. None, NaN and infinity become null.
    """
    return finite(arrays(opened))


def arrays(opened: Opened) -> dict[str, Any]:
    """Return everything about an opened pixel as nested dicts and lists of arrays and numbers.

    Parts that are not computed yet are left out. Of a ray without samples, "lacks" says so and "visited" has the places
    that the method looked at. The names are those of the records in `nerf_core.probe`, except that
    `Standing.training_views` is called "witnesses", as in files of earlier versions.
    """
    found = {
        "scene": opened.scene.name,
        "method": opened.method,
        "step": opened.ray.step,
        "camera": camera_values(opened.camera),
        **_ray_values(opened.ray),
    }
    if not opened.ray.passes:
        found |= {"lacks": WITHOUT_SAMPLES, "visited": opened.ray.visited}
    if opened.scene.ndc is not None:
        found["ndc"] = asdict(opened.scene.ndc)
    if opened.verdict is not None:
        found["verdict"] = _verdict_values(opened.verdict)
    if opened.radiance is not None:
        found["radiance"] = {name: getattr(opened.radiance, name) for name in RADIANCE}
    if opened.evidence is not None:
        photos = np.array([opened.scene.views[k].name for k in opened.evidence.views], str)
        found["evidence"] = {"photos": photos, **_plain(opened.evidence)}
    if opened.name:
        found["name"] = opened.name
    if opened.history is not None:
        found["history"] = _plain(opened.history)
    return found


def _ray_values(ray: RayProbe) -> dict[str, Any]:
    return {
        "pixel": list(ray.pixel),
        "origin": ray.origin,
        "direction": ray.direction,
        "near": ray.near,
        "far": ray.far,
        "background": ray.background,
        "passes": [_plain(one) for one in ray.passes],
        "color": ray.color,
        "opacity": ray.opacity,
        "depth_expected": ray.depth_expected,
        "depth_median": ray.depth_median,
        "depth_strongest": ray.depth_strongest,
        "rendered_color": ray.rendered_color,
        "begins": ray.begins,
    }


def _verdict_values(verdict: Verdict) -> dict[str, Any]:
    return {
        "kind": verdict.kind,
        "reasons": np.array(verdict.reasons, str),
        "surface_t": verdict.surface_t,
        "layers": [
            {
                **_plain(s.layer),
                "witnesses": s.training_views,
                "looked": s.looked,
                "voters": s.voters,
                "against": s.against,
                "missing": s.missing,
                "blank": s.blank,
                "shown": s.shown,
                "error": s.error,
                "without": s.without,
                "opaque": s.opaque,
            }
            for s in verdict.standings
        ],
    }


def _plain(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in fields(value)}


# ---- files --------------------------------------------------------------------------------------------------------


def write_inspection(opened: Sequence[Opened], file: Path, axis: AxisChoice = "auto") -> None:
    """Write opened pixels to a file, in the format of its suffix.

    - .json: the object of `inspection`; {"rays": [...]} for several pixels.
    - .npz: the arrays of `arrays`, with nested names joined by "/"; several pixels begin with "rays/0/", "rays/1/", ….
    - .csv: one line for each sample, or for each place that a method without samples looked at.
    - .png, .svg: a figure with one row for each pixel.

    Args:
        opened: one or more opened pixels.
        file: the file to write. It is replaced as a whole or not at all.
        axis: of a figure: world distance, contracted distance, or what suits the ray; see `chosen_axis`.

    Raises:
        UserError: the suffix is none of these, there are no pixels, or the file cannot be written.
    """
    check_format(file)
    if not opened:
        raise UserError(f"{file}: there is no opened ray to write")
    write_atomically(file, FORMATS[file.suffix.lower()](opened, axis))


def check_format(file: Path) -> None:
    """Raise UserError if `write_inspection` has no format for the suffix of `file`."""
    if file.suffix.lower() not in FORMATS:
        raise UserError(f"{file}: an opened ray is written as {', '.join(FORMATS)}: name such a file")


def _json(opened: Sequence[Opened], _: AxisChoice) -> bytes:
    found = [inspection(one) for one in opened]
    return json.dumps(found[0] if len(found) == 1 else {"rays": found}, allow_nan=False).encode()


def _npz(opened: Sequence[Opened], _: AxisChoice) -> bytes:
    flat: dict[str, np.ndarray] = {}
    for k, one in enumerate(opened):
        _flatten(arrays(one), f"rays/{k}/" if len(opened) > 1 else "", flat)
    data = io.BytesIO()
    assert not any(array.dtype.hasobject for array in flat.values())  # numpy would pickle them
    np.savez_compressed(data, **flat)  # pyright: ignore[reportArgumentType]  none of the names is an option
    return data.getvalue()


def _flatten(value: Any, name: str, into: dict[str, np.ndarray]) -> None:
    """Fill `into` with arrays whose names are joined by "/".

    None becomes NaN, and text becomes a text array: numpy would have to unpickle an object array.
    """
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _flatten(inner, f"{name}{key}/", into)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for k, inner in enumerate(value):
            _flatten(inner, f"{name}{k}/", into)
    else:
        into[name.rstrip("/")] = np.asarray(np.nan if value is None else value)


def _csv(opened: Sequence[Opened], _: AxisChoice) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["ray", "pass", "sample", *SAMPLE, "red", "green", "blue"])
    for k, one in enumerate(opened):
        for p in one.ray.passes:
            writer.writerows([k, p.name, i, *row] for i, row in enumerate(_rows(p)))
        blank = [""] * (len(SAMPLE) + 2)  # of a place that a method without samples looks at, only t is known
        writer.writerows([k, "visited", i, t, *blank] for i, t in enumerate(one.ray.visited.tolist()))
    return text.getvalue().encode()


def _rows(p: PassProbe) -> list[list[float]]:
    return np.column_stack([*(getattr(p, name) for name in SAMPLE), p.rgb]).astype(float).tolist()


def _figure(kind: str) -> Callable[[Sequence[Opened], AxisChoice], bytes]:
    def made(opened: Sequence[Opened], axis: AxisChoice) -> bytes:
        from nerf_core.probe.figure import figure

        return figure(opened, kind, axis)

    return made


FORMATS: dict[str, Callable[[Sequence[Opened], AxisChoice], bytes]] = {
    ".json": _json, ".npz": _npz, ".csv": _csv, ".png": _figure("png"), ".svg": _figure("svg"),
}  # fmt: skip
