"""Searches for poses, as tests begin and judge them."""

from __future__ import annotations

from pathlib import Path

from nerf_core.captures.posing import Posed
from nerf_core.captures.raw_photos import RawPhotos, raw_photos
from nerf_core.captures.records import PoseOptions, PoseProgress
from nerf_core.datasets import LoadOptions
from nerf_core.datasets.capture import DATASETS
from nerf_core.geometry.camera import Camera

FAST = PoseOptions("fast")


def of(path: Path) -> RawPhotos:
    raw = raw_photos(path)
    assert raw is not None
    return raw


def cameras_of(posed: Posed) -> list[Camera]:
    return [photo.camera for photo in DATASETS.get("colmap").read(posed.folder, LoadOptions()).photos]


def quiet(_: PoseProgress) -> None:
    pass


def files(folder: Path) -> list[str]:
    return sorted(str(f.relative_to(folder)) for f in folder.rglob("*"))
