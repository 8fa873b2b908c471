"""What finding poses takes and tells: plain values and numpy arrays, which messages carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nerf_core.common.language import marked
from nerf_core.datasets.capture import PoseLens, Quality

STAGES = {  # of the program, in their order
    "features": marked("finding features"),
    "matches": marked("matching pairs of photos"),
    "poses": marked("placing photos"),
}
COPYING = marked("reading photos")
PLACED = marked("photos placed")  # after the last stage
MOST_SHOWN = 120  # thumbnails: more would be too small in a window


def thumbnails_of(total: int) -> range:
    """Return which of so many photos have a thumbnail: evenly spread, MOST_SHOWN at most."""
    return range(0, total, max(1, -(-total // MOST_SHOWN)))


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found. What cannot be chosen here follows from the photos.

    quality: how large the photos are looked at, and how many features they get.
    frames: how many frames of a video are taken; 0 chooses by its length.
    minutes: the time limit.
    memory_gb: the memory limit of the program; 0: three quarters of what is free.
    lens: what took the photos: a perspective or a fisheye lens.
    """

    quality: Quality = "normal"
    frames: int = 0
    minutes: float = 120.0
    memory_gb: float = 0.0
    lens: PoseLens = "perspective"


class Growing(NamedTuple):
    """A model that grows. poses: (N, 3, 4) camera to world, OpenGL axes. points: (P, 3). colors: (P, 3) uint8."""

    poses: np.ndarray
    points: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class PoseProgress:
    """How far it is.

    stage: what is done now, a phrase.
    done, total: of this stage; in photos, or in pairs of photos while they are matched.
    photos: all that are to be placed.
    placed: those that have a pose.
    seconds_left: of this stage; None: not known yet.
    growing: the newest model.
    thumbnails: (h, w, 4) uint8 each, of those of `thumbnails_of` that could be read so far.
    """

    stage: str
    done: int = 0
    total: int = 0
    photos: int = 0
    placed: int = 0
    seconds_left: float | None = None
    growing: Growing | None = None
    thumbnails: tuple[np.ndarray, ...] = ()
