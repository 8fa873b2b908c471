"""What a capture report holds: facts of each photo, gaps between photos, findings. Plain values and numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Kind = Literal["around", "one-sided", "forward-facing", "free", "single"]


@dataclass(frozen=True)
class PhotoFacts:
    """One photo. Angles are in degrees, lengths in scene units.

    name, split: as in the scene.
    view: its index in the scene.
    size: (width, height) in pixels, as loaded.
    position, forward: (3,) of the camera: right, away from the front, and up; from the centre.
    azimuth: around the centre, 0 in front, to the right positive. elevation: above the centre's plane.
    distance: from the centre.
    off_centre: the angle between the optical axis and the direction to the centre.
    nearest: the index in the report of the training photo with the most similar view; −1: there is none.
    separation: how far that view is; see `report_views.separations`.
    nearest_by_place: the index of the training photo that was taken nearest to it; −1: there is none.
    place_distance: the distance to it.
    field_of_view: across the width.
    sharpness: see `sharpness.Measure`; NaN: the photo shows nothing.
    relative_sharpness: that over the median of similar views.
    exposure: mean log2 of the luminance, in stops below white.
    relative_exposure: that less the median of similar views.
    highlights, shadows: shares of pixels that are clipped.
    thumbnail: a small WebP file.
    odd: a sentence for each thing that sets the photo apart.
    """

    name: str
    split: str
    view: int
    size: tuple[int, int]
    position: np.ndarray
    forward: np.ndarray
    azimuth: float
    elevation: float
    distance: float
    off_centre: float
    nearest: int
    separation: float
    nearest_by_place: int
    place_distance: float
    field_of_view: float
    sharpness: float
    relative_sharpness: float
    exposure: float
    relative_exposure: float
    highlights: float
    shadows: float
    thumbnail: bytes = b""
    odd: tuple[str, ...] = ()


@dataclass(frozen=True)
class Gap:
    """Directions from which there is no photo within `report_views.FAR_DEGREES`.

    first, last: azimuths of its ends, in degrees; `last` is the larger, and may exceed 180.
    low, high: elevations, in degrees.
    text: where it is, in words.
    """

    first: float
    last: float
    low: float
    high: float
    text: str

    @property
    def width(self) -> float:
        return self.last - self.first


@dataclass(frozen=True)
class Finding:
    """Something that limits the quality.

    kind: of a fixed list, for programs.
    score: how much it limits, for the order.
    text: what was found. advice: what to do.
    photos: indices of the photos that it is about.
    """

    kind: str
    score: float
    text: str
    advice: str
    photos: tuple[int, ...] = ()


@dataclass(frozen=True, repr=False)
class CaptureReport:
    """What the photos and poses of a capture say before anything is trained.

    name, format: of the scene.
    kind: how the cameras stand.
    overall: what it is good for, what limits it most, and what to do next.
    summary: a sentence on how the cameras stand.
    photos: all, in the scene's order.
    front: the index of the photo whose direction counts as the front; −1: the mean direction of view.
    center: (3,) of the scene; axes: (3, 3) rows right, away and up, in the scene's frame.
    center_name: what the centre is, in words.
    points: (P, 3) sparse points in the photos' coordinates, which may be none.
    elevations: the lowest and highest elevation that photos have.
    uncovered: (A, E) whether no photo is near, for azimuths (A,) and elevations (E,) in `azimuths` and `heights`.
    gaps: what that amounts to in words.
    limits: what limits the quality, the worst first. next: what to photograph next, the most useful first.
    calibration: what the cameras' calibration is, a line each.
    notes: the scene's.
    units_to_input: how many units of the input files one scene unit is.
    """

    name: str
    format: str
    kind: Kind
    overall: str
    summary: str
    photos: tuple[PhotoFacts, ...]
    front: int
    center: np.ndarray
    axes: np.ndarray
    center_name: str
    points: np.ndarray
    azimuths: np.ndarray
    heights: np.ndarray
    uncovered: np.ndarray
    gaps: tuple[Gap, ...]
    limits: tuple[Finding, ...]
    next: tuple[str, ...]
    calibration: tuple[str, ...]
    notes: tuple[str, ...] = ()
    units_to_input: float = 1.0

    def __repr__(self) -> str:
        return f"CaptureReport({self.name!r}, {self.kind}, {len(self.photos)} photos, {len(self.limits)} limits)"


@dataclass(frozen=True)
class ReportState:
    """The progress of a report in the worker.

    state: what became of it. fraction, text: how far it is, while it runs.
    loaded: `Snapshot.loaded` of the scene that it is about.
    report: when it is done.
    """

    state: Literal["running", "done", "cancelled", "failed"]
    fraction: float = 0.0
    text: str = ""
    loaded: int = 0
    report: CaptureReport | None = field(default=None, compare=False)
