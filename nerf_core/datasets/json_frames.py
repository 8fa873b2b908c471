"""Turn the frames of transforms files (Blender, instant-ngp, nerfstudio) into photos with cameras."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.json_files import Fields, scaled_note
from nerf_core.common.language import phrases
from nerf_core.datasets.capture import Photo
from nerf_core.datasets.images import UnreadableError, damage_notes, measure
from nerf_core.datasets.photo_paths import find_photos, photo_name
from nerf_core.datasets.posed_files import NARROWEST
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Lens

LENSES = {  # {camera_model: the coefficients that it may have}
    "PINHOLE": ("k1", "k2", "k3", "p1", "p2"),
    "SIMPLE_PINHOLE": ("k1", "k2", "k3", "p1", "p2"),
    "SIMPLE_RADIAL": ("k1", "k2", "k3", "p1", "p2"),
    "RADIAL": ("k1", "k2", "k3", "p1", "p2"),
    "OPENCV": ("k1", "k2", "k3", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "EQUIRECTANGULAR": (),
}
COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2", "k4")
FIELDS = {"OPENCV_FISHEYE": FISHEYE, "EQUIRECTANGULAR": EQUIRECTANGULAR}
TURN_TOLERANCE = 0.02  # of a panorama's size: programs that shrink photos round each side to whole pixels


@dataclass(frozen=True)
class Frame:
    """One entry of `frames`, with its split if it has one. A field that the entry lacks is looked up in the file."""

    fields: Fields
    common: Fields
    split: str = ""

    @property
    def listed(self) -> str:
        return self.fields.text("file_path")

    def holder(self, *keys: str) -> tuple[Fields, str] | None:
        """The first of `keys` that the frame has, or else that the file has, with the object that holds it."""
        for fields in (self.fields, self.common):
            for key in keys:
                if key in fields:
                    return fields, key
        return None


@dataclass(frozen=True)
class Gathered:
    """The photos of all frames.

    photos: each file once.
    index: the place of each frame in `photos`; None if its photo cannot be used.
    """

    photos: tuple[Photo, ...]
    index: tuple[int | None, ...]
    notes: tuple[str, ...]


def frames_of(document: Fields, split: str = "") -> list[Frame]:
    """Return the entries of a transforms file. Raises UserError if there are none."""
    return [Frame(child, document, split) for child in document.children("frames")]


def gather(folder: Path, frames: Sequence[Frame], source: Path) -> Gathered:
    """Find the photos of all frames below `folder` and give them cameras. Missing and repeated photos are noted."""
    poses = [frame.fields.pose("transform_matrix") for frame in frames]
    found = find_photos(folder, [frame.listed for frame in frames], source)
    photos: dict[str, tuple[int, Photo]] = {}
    seen: set[tuple[str, str]] = set()
    index: list[int | None] = []
    damaged: list[str] = []
    doubles: list[str] = []
    lacking: list[str] = []
    for frame, (c2w, _), path in zip(frames, poses, found.paths, strict=True):
        key = os.path.abspath(path) if path else ""
        if path is not None and key not in photos:
            try:
                mask = _mask(frame, folder)
                if mask is not None and not os.path.exists(mask):
                    lacking.append(str(mask))
                    mask = None
                camera = _camera(frame, path, c2w)
                photos[key] = (len(photos), Photo(photo_name(folder, path), path, camera, mask))
            except UnreadableError as error:
                damaged.append(str(error))
        if path is None or key not in photos:
            index.append(None)
            continue
        place, photo = photos[key]
        repeated = (frame.split, key) in seen
        if repeated or not np.array_equal(photo.camera.c2w, c2w):
            doubles.append(photo.name)
        seen.add((frame.split, key))
        index.append(None if repeated else place)
    if not photos:
        raise UserError(f"{source}: no listed photo can be read ({damaged[0]}): save them as PNG or JPEG")
    notes = [*found.notes, *scaled_note(source, [length for _, length in poses]), *damage_notes(damaged)]
    if lacking:
        notes.append(
            phrases(
                "{file}: {n:,} listed mask is missing, {first}; its photo is used whole",
                "{file}: {n:,} listed masks are missing, first {first}; their photos are used whole",
                len(lacking),
                file=source,
                first=lacking[0],
            )
        )
    if doubles:
        notes.append(
            phrases(
                "{file}: {n:,} photo listed more than once (first {first}); the first pose holds",
                "{file}: {n:,} photos listed more than once (first {first}); the first pose holds",
                len(doubles),
                file=source,
                first=doubles[0],
            )
        )
    return Gathered(tuple(photo for _, photo in photos.values()), tuple(index), tuple(notes))


def bounds(document: Fields) -> tuple[float, float] | None:
    """Return the z-depths `near` and `far` if the file has both, else None. Raises UserError unless 0 < near < far."""
    if "near" not in document and "far" not in document:
        return None
    near, far = document.positive("near"), document.positive("far")
    if near >= far:
        raise document.error("far", f"a number above near, {near:g}, is needed")
    return near, far


def _mask(frame: Frame, folder: Path) -> Path | None:
    """The listed mask of a frame (nerfstudio's `mask_path`), which may not exist; None if the frame lists none."""
    return folder / frame.fields.text("mask_path") if "mask_path" in frame.fields else None


def _camera(frame: Frame, path: Path, c2w: np.ndarray) -> Camera:
    """The camera of one frame. If the file states no size, the photo's own counts."""
    lens = _lens(frame)
    wide, high = frame.holder("w"), frame.holder("h")
    if wide and high:
        width, height = wide[0].count("w"), high[0].count("h")
    else:
        header = measure(path)
        width = wide[0].count("w") if wide else header.width
        height = high[0].count("h") if high else max(1, round(header.height * width / header.width))
    if lens.kind == EQUIRECTANGULAR:
        return _panorama(frame, width, height, c2w, lens)
    fx, fy = _focal(frame, "x", width, lens), _focal(frame, "y", height, lens)
    if fx is None and fy is None:
        raise UserError(f"{frame.fields.file}: fl_x and camera_angle_x are missing: add one of them")
    return Camera(
        width,
        height,
        fx=fx or fy or 0.0,
        fy=fy or fx or 0.0,
        cx=_optional(frame, "cx", width / 2),
        cy=_optional(frame, "cy", height / 2),
        c2w=c2w,
        lens=lens,
    )


def _panorama(frame: Frame, width: int, height: int, c2w: np.ndarray, lens: Lens) -> Camera:
    """The camera of an equirectangular picture, whose focal length is in pixels a radian.

    nerfstudio counts in pixels a half turn: fl_x = fl_y = h = w / 2 for a picture of everything around.
    """
    turn = {axis: frame.holder(f"fl_{axis}") for axis in "xy"}
    fx, fy = (
        holder[0].positive(holder[1]) if (holder := turn[axis]) else size
        for axis, size in (("x", width / 2), ("y", float(height)))
    )
    for axis, focal, least in (("x", fx, width / 2), ("y", fy, float(height))):
        if focal < least * (1 - TURN_TOLERANCE) and (holder := turn[axis]):
            raise holder[0].error(
                holder[1], f"at least {least:g} is needed, the pixels of a half turn, or no {holder[1]}"
            )
    cx, cy = _optional(frame, "cx", width / 2), _optional(frame, "cy", height / 2)
    return Camera(width, height, fx / math.pi, fy / math.pi, cx, cy, c2w, lens)


def _focal(frame: Frame, axis: str, size: int, lens: Lens) -> float | None:
    """The focal length in pixels: fl, else (size / 2) / tan(angle / 2), else None. Raises UserError."""
    holder = frame.holder(f"fl_{axis}", f"camera_angle_{axis}")
    if holder is None:
        return None
    fields, key = holder
    value = fields.positive(key)
    if key.startswith("camera_angle") and lens.kind == FISHEYE:
        raise fields.error(key, "the focal length of a fisheye lens does not follow from it; fl_x is needed")
    if key.startswith("camera_angle"):
        if value >= math.pi:
            raise fields.error(key, "an angle below π (180°) in radians is needed")
        value = size / 2 / math.tan(value / 2)
    if value < NARROWEST * size:
        raise fields.error(key, f"no lens sees that wide; a focal length in pixels of a photo of {size} is needed")
    return value


def _optional(frame: Frame, key: str, default: float) -> float:
    holder = frame.holder(key)
    return holder[0].number(key) if holder else default


def _lens(frame: Frame) -> Lens:
    """The lens of one frame. Raises UserError for a model that is not known, or a coefficient that it does not have."""
    model, holder = "OPENCV", frame.holder("camera_model")
    if holder:
        model = holder[0].text("camera_model").upper()
        if model not in LENSES:
            raise holder[0].error("camera_model", f"known are {', '.join(LENSES)}; undistort the photos first")
    fisheye = frame.holder("is_fisheye")
    if fisheye and fisheye[0].values["is_fisheye"] and model != "OPENCV_FISHEYE":
        if holder:
            raise fisheye[0].error("is_fisheye", f"but camera_model is {model}; remove one of them")
        model = "OPENCV_FISHEYE"  # instant-ngp's word for OpenCV's fisheye lens
    values = {}
    for key in COEFFICIENTS:
        values[key] = _optional(frame, key, 0.0)
        if values[key] and key not in LENSES[model]:
            owner = frame.holder(key)
            assert owner is not None
            raise owner[0].error(key, f"the lens {model} has no such coefficient; remove it or correct camera_model")
    return Lens(**values, kind=FIELDS.get(model, PERSPECTIVE))
