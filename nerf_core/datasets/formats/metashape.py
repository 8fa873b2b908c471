"""Agisoft Metashape's cameras as XML (File, Export, Export Cameras), beside the photos or a folder images.

Written from the camera models in the appendix of Metashape's user manual, and from nerfstudio's reader. With x and y on
the image plane and r² = x² + y²:

    x′ = x (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P1 (r² + 2 x²) + 2 P2 x y     u = w / 2 + cx + x′ (f + B1) + y′ B2
    y′ = y (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P2 (r² + 2 y²) + 2 P1 x y     v = h / 2 + cy + y′ f

P1 and P2 are therefore OpenCV's p2 and p1. In a fisheye picture the same is done with points at distance θ from the
centre. A spherical picture shows longitude and latitude. A camera's transform is camera to chunk, with y down and z
forward; that of its component, or else of the chunk, is chunk to world.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from xml.etree.ElementTree import Element

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrase
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions
from nerf_core.datasets.posed_files import (
    AGAIN,
    Posed,
    checked_camera,
    chosen_file,
    number_of,
    numbers_of,
    photo_home,
    posed_photos,
    rotation_of,
)
from nerf_core.datasets.xml_files import read_xml
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Lens

KINDS = {
    "frame": PERSPECTIVE, "fisheye": FISHEYE, "equidistant_fisheye": FISHEYE, "spherical": EQUIRECTANGULAR,
}  # fmt: skip
# What a lens of each kind has not: other values than 0 are refused
LACKS = {
    PERSPECTIVE: ("k4", "p3", "p4", "b2"), FISHEYE: ("p1", "p2", "p3", "p4", "b2"),
    EQUIRECTANGULAR: ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2"),
}  # fmt: skip
WORDS = (b"<document", b"<chunk")
OFF = ("false", "0")


@DATASETS.register("metashape")
class Metashape:
    """Cameras without a pose are left out, with a note. Of several components the one with most cameras is read."""

    rank: ClassVar[int] = 7
    files: ClassVar[str] = "cameras.xml with images"

    @staticmethod
    def matches(path: Path) -> bool:
        return chosen_file(path, ".xml", "cameras.xml", WORDS) is not None

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by label. Raises UserError."""
        file = chosen_file(path, ".xml", "cameras.xml", WORDS)
        if file is None:
            raise UserError(f"{path} has no XML file of cameras: export the cameras from Metashape there")
        chunk = read_xml(file).find("chunk")
        if chunk is None:
            raise UserError(f"{file} has no chunk: export the cameras from Metashape again")
        sensors = {s.get("id", ""): s for s in chunk.iterfind("sensors/sensor")}
        cameras = list(chunk.iterfind("cameras//camera"))
        posed = [c for c in cameras if c.find("transform") is not None and c.get("enabled") not in OFF]
        if not posed:
            raise UserError(f"{file}: none of {len(cameras)} cameras has a pose: align the photos, and {AGAIN}")
        component, _ = Counter(c.get("component_id", "") for c in posed).most_common(1)[0]
        kept = [c for c in posed if c.get("component_id", "") == component]
        world = _world(chunk, component, str(file))
        known: dict[str, _Sensor] = {}
        entries = [_entry(c, sensors, known, world, str(file)) for c in sorted(kept, key=lambda c: c.get("label", ""))]
        photos, notes = posed_photos(photo_home(file.parent), file, entries)
        if len(kept) < len(cameras):
            notes += (
                phrase(
                    "{file}: {count} of {total} cameras left out: without a pose, disabled, or of another component",
                    file=file,
                    count=len(cameras) - len(kept),
                    total=len(cameras),
                ),
            )
        return Capture(format="metashape", photos=photos, notes=notes)


@dataclass(frozen=True)
class _Sensor:
    """The calibration of a sensor: width and height, focal lengths and principal point in pixels, and the lens."""

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    lens: Lens


def _entry(
    camera: Element, sensors: Mapping[str, Element], known: dict[str, _Sensor], world: np.ndarray, file: str
) -> Posed:
    label, name = camera.get("label", ""), camera.get("sensor_id", "")
    where = f"{file}: camera {shorten(label)}"
    if not label:
        raise UserError(f"{file}: a camera has no label, which names its photo: {AGAIN}")
    if name not in sensors:
        raise UserError(f"{where} has the sensor {shorten(name)}, which is not in the file: {AGAIN}")
    if name not in known:
        known[name] = _sensor(sensors[name], f"{file}: sensor {shorten(name)}")
    matrix = numbers_of(camera.findtext("transform"), 16, f"{where}: transform").reshape(4, 4)
    placed = world @ matrix
    rotation = rotation_of(placed[:3, :3], f"{where}: transform") * (1, -1, -1)  # y down and z forward → OpenGL
    sensor = known[name]
    made = checked_camera(
        where, sensor.size, sensor.focal, sensor.center, np.column_stack([rotation, placed[:3, 3]]), sensor.lens
    )
    return Posed(label, lambda _: made)


def _sensor(sensor: Element, where: str) -> _Sensor:
    """Read a sensor's newest calibration. Raises UserError for lenses that this program has not."""
    kind = KINDS.get(sensor.get("type", "frame"))
    if kind is None:
        raise UserError(
            f"{where} has the type {shorten(sensor.get('type'))}; known are {', '.join(KINDS)}: undistort the photos "
            "in Metashape, and export their cameras"
        )
    size = sensor.find("resolution")
    numbers = {} if size is None else {key: number_of(size.get(key), f"{where}: {key}") for key in ("width", "height")}
    if size is None or not all(v >= 1 and v == round(v) for v in numbers.values()):
        raise UserError(f"{where} has no resolution of whole pixels: {AGAIN}")
    width, height = round(numbers["width"]), round(numbers["height"])
    found = sensor.findall("calibration")
    adjusted = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if kind == EQUIRECTANGULAR:
        focal: tuple[float, float] = width / 2 / math.pi, height / math.pi
    elif adjusted is None:
        raise UserError(f"{where} has no calibration: align the photos, and {AGAIN}")
    else:
        focal = (0.0, 0.0)

    def value(key: str) -> float:
        text = None if adjusted is None else adjusted.findtext(key)
        return 0.0 if text is None else number_of(text, f"{where}: {key}")

    for key in LACKS[kind]:
        if value(key):
            raise UserError(
                f"{where} has {key} = {value(key):g}, which is not known here: optimise the cameras without it, or "
                "undistort the photos in Metashape"
            )
    if kind != EQUIRECTANGULAR:
        focal = value("f") + value("b1"), value("f")
    radial = {"k1": value("k1"), "k2": value("k2"), "k3": value("k3")}
    extra = {"k4": value("k4")} if kind == FISHEYE else {"p1": value("p2"), "p2": value("p1")}
    lens = Lens(**radial, **extra, kind=kind)
    return _Sensor((width, height), focal, (width / 2 + value("cx"), height / 2 + value("cy")), lens)


def _world(chunk: Element, component: str, file: str) -> np.ndarray:
    """Return the similarity (4, 4) to the world: that of a component, else that of the chunk, else the identity."""
    transforms = [
        c.find("transform") for c in chunk.iterfind("components/component") if c.get("id", "") == component
    ] + [chunk.find("transform")]
    transform = next((t for t in transforms if t is not None), None)
    world, where = np.eye(4), f"{file}: the chunk's transform"
    if transform is None:
        return world
    if (text := transform.findtext("rotation")) is not None:
        world[:3, :3] = rotation_of(numbers_of(text, 9, f"{where}: rotation").reshape(3, 3), where)
    if (text := transform.findtext("translation")) is not None:
        world[:3, 3] = numbers_of(text, 3, f"{where}: translation")
    if (text := transform.findtext("scale")) is not None:
        scale = number_of(text, f"{where}: scale")
        if scale <= 0:
            raise UserError(f"{where} has the scale {scale:g}: a number above 0 is needed, {AGAIN}")
        world[:3, :3] *= scale
    return world
