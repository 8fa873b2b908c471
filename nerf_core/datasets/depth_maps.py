"""Read the depth maps that a device recorded with its photos, for the bounds of a capture's content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrases
from nerf_core.datasets.capture import Depths
from nerf_core.datasets.depths import robust_depths
from nerf_core.datasets.exr import exr_plane
from nerf_core.datasets.images import BROKEN, UnreadableError, measure

MOST_MAPS = 50  # that are read, evenly spread: a percentile needs no more, and an EXR map takes a twentieth of a second
PIXELS = 4000  # of each that are taken, evenly spread
MILLIMETRES = 1000.0
LOW = 0.4  # of full confidence: of ARKit's three values 0, 127 and 255 only the lowest lies below
ASPECT_TOLERANCE = 0.02  # maps are much smaller than photos, and their sides are rounded
ENOUGH = 0.01  # of a map's pixels that must have a depth


@dataclass(frozen=True)
class DepthMap:
    """The map of a photo.

    file: a 16-bit PNG in millimetres, or an EXR of one channel in metres. 0, and a PNG's largest value: unknown.
    size: width and height of the photo.
    confidence: an 8-bit PNG, 255 where the depth is certain; None: there is none.
    """

    file: Path
    size: tuple[int, int]
    confidence: Path | None = None


def recorded_depths(maps: Sequence[DepthMap]) -> tuple[Depths | None, tuple[str, ...]]:
    """Return the depths that some of the maps tell, in metres, and notes about maps that cannot be used.

    Pixels of low confidence tell only how far content may reach: LiDAR sees five metres, and what is behind is guessed.
    """
    chosen = [maps[i] for i in np.unique(np.linspace(0, len(maps) - 1, min(len(maps), MOST_MAPS)).round().astype(int))]
    sure, every, faults = [np.empty(0)], [np.empty(0)], []
    for one in chosen:
        try:
            z, certain = _pixels(one)
        except (UnreadableError, UserError, *BROKEN) as error:
            faults.append(shorten(str(error), 200))
            continue
        sure.append(z[certain])
        every.append(z)
    notes = (
        (
            phrases(
                "{n:,} depth map of {total:,} that were tried is not used: {first}",
                "{n:,} depth maps of {total:,} that were tried are not used, first: {first}",
                len(faults),
                total=len(chosen),
                first=faults[0],
            ),
        )
        if faults
        else ()
    )
    z = np.concatenate(sure)
    return (robust_depths(z, np.concatenate(every)) if len(z) else None), notes


def _pixels(one: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    """Some depths of a map (K,) in metres, and which are certain (K,). Raises UnreadableError for a wrong map."""
    depth = _metres(one.file)
    height, width = depth.shape
    if abs(width / height * one.size[1] / one.size[0] - 1) > ASPECT_TOLERANCE:
        raise UnreadableError(
            f"{one.file} has {width}×{height} pixels, its photo {one.size[0]}×{one.size[1]}: another shape"
        )
    certain = np.ones(depth.shape, bool)
    if one.confidence is not None:
        confidence = _plane(one.confidence, "L")
        if confidence.shape != depth.shape:
            raise UnreadableError(f"{one.confidence} has another size than {one.file}")
        certain = confidence >= LOW * 255
    apart = max(1, round((depth.size / PIXELS) ** 0.5))
    depth, certain = depth[apart // 2 :: apart, apart // 2 :: apart], certain[apart // 2 :: apart, apart // 2 :: apart]
    known = np.isfinite(depth) & (depth > 0)
    if known.mean() < ENOUGH:
        raise UnreadableError(f"{one.file} holds no depths: all are 0 or no numbers")
    return depth[known].astype(np.float64), certain[known]


def _metres(file: Path) -> np.ndarray:
    """A depth map (H, W) float32 in metres."""
    if file.suffix.lower() == ".exr":
        measure(file)
        try:
            return exr_plane(file)
        except OSError as error:
            raise UnreadableError(f"{file} {error}") from error
    levels = _plane(file, "I;16")
    return np.where(levels < 65535, levels, 0).astype(np.float32) / np.float32(MILLIMETRES)


def _plane(file: Path, mode: str) -> np.ndarray:
    """The values (H, W) of a grey PNG as they are stored. mode: of Pillow, "L" for 8 bits, "I;16" for 16."""
    measure(file)
    with Image.open(file) as stored:
        if stored.mode != mode:
            bits = 16 if mode == "I;16" else 8
            raise UnreadableError(f"{file} is not a grey picture of {bits} bits (Pillow's mode {stored.mode})")
        return np.asarray(stored)
