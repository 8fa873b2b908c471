"""Polycam's raw data: one JSON file with calibration and pose for each photo.

Written from the description of the format in the README of github.com/PolyCam/polyform. The pose is camera to world in
ARKit's frame, whose y axis points up, and the camera's axes are OpenGL's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.json_files import Fields, read_json, scaled_note
from nerf_core.common.language import phrase
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions, Photo
from nerf_core.datasets.depth_maps import DepthMap, recorded_depths
from nerf_core.datasets.posed_files import Posed, checked_camera, posed_photos
from nerf_core.geometry.camera import Camera

# (calibrations, photos): the app's optimised poses fit the undistorted photos. It writes them for smaller captures.
PAIRS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
POSE = "t_00 … t_23"


@DATASETS.register("polycam")
class Polycam:
    """The corrected photos and poses are taken if the capture has them."""

    rank: ClassVar[int] = 5
    files: ClassVar[str] = "keyframes with cameras and images"

    @staticmethod
    def matches(path: Path) -> bool:
        return path.is_dir() and _folders(path) is not None

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by name, which is their time. Raises UserError."""
        found = _folders(path)
        if found is None:
            raise UserError(
                f"{path} has no keyframes/cameras/*.json beside keyframes/images: export the raw data again"
            )
        cameras, images = found
        base = cameras.parent
        entries, lengths = [], []
        for file in sorted(cameras.glob("*.json")):
            camera, length = _camera(read_json(file, "an object with t_00 … t_23"))
            entries.append(Posed(f"{images.name}/{file.stem}", lambda _, camera=camera: camera))
            lengths.append(length)
        photos, notes = posed_photos(base, cameras, entries)
        notes += tuple(scaled_note(cameras, lengths))
        if cameras.name != PAIRS[0][0]:
            notes += (
                phrase(
                    "{folder}: no corrected_cameras with corrected_images; photos and poses are as the device recorded "
                    "them",
                    folder=base,
                ),
            )
        maps = _depth_maps(base, photos)
        depths, depth_notes = recorded_depths(maps) if maps else (None, ())
        return Capture(
            format="polycam", photos=photos, depths=depths, up=np.array([0.0, 1.0, 0.0]), notes=notes + depth_notes
        )


def _folders(path: Path) -> tuple[Path, Path] | None:
    """The folders of calibrations and photos; None if there are none."""
    for base in (path / "keyframes", path):
        for cameras, images in PAIRS:
            if (base / images).is_dir() and next((base / cameras).glob("*.json"), None) is not None:
                return base / cameras, base / images
    return None


def _depth_maps(base: Path, photos: Sequence[Photo]) -> list[DepthMap]:
    """The depth maps of photos: depth/NAME.png in millimetres, and confidence/NAME.png beside it."""
    found = []
    for photo in photos:
        file, confidence = (base / kind / f"{photo.path.stem}.png" for kind in ("depth", "confidence"))
        if file.is_file():
            size = photo.camera.width, photo.camera.height
            found.append(DepthMap(file, size, confidence if confidence.is_file() else None))
    return found


def _camera(fields: Fields) -> tuple[Camera, float]:
    """The camera of one file, and the length that its axes had there."""
    rows = [[fields.number(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    c2w, length = Fields({POSE: rows}, fields.file).pose(POSE)
    size = fields.count("width"), fields.count("height")
    focal, center = (fields.positive("fx"), fields.positive("fy")), (fields.number("cx"), fields.number("cy"))
    return checked_camera(str(fields.file), size, focal, center, c2w), length
