"""How the cameras of a capture stand: around something or side by side, what they cover, which views are similar."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from nerf_core.captures.report_records import Gap, Kind
from nerf_core.common.language import marked, phrase
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.turntable import STEEP, horizontal_axes

# Matching and interpolation both fail between views that differ more: the repeatability of local features falls below a
# half at about 30° (Mikolajczyk & Schmid, A performance evaluation of local descriptors, 2005).
FAR_DEGREES = 30.0
ONE_WAY = 35.0  # of 95 % of the optical axes from their mean: LLFF's forward-facing captures have 10° to 30°
# of the optical axes to the centre: half of a wide lens's diagonal, so that the centre is in the picture
TOWARDS = 45.0
INWARD = 0.7  # share of the cameras that look towards the centre, of those that stand around it
HALF_ROUND = 200.0  # degrees of azimuth: a walk to and fro in front of a wall reaches 180° at most, with some slack
CLEAR = 0.3  # length of the mean horizontal direction from which it is a front, and not chance: a ring has about 0
NEIGHBOURS = 6  # similar views that a photo is compared with: a median of 6 bears two odd ones
CELL = 5.0  # degrees of the grid on which directions are checked
LEAST_COLUMNS = 2  # narrower gaps are below the grid's error

SIDES = (
    marked("the front"), marked("the front right"), marked("the right"), marked("behind right"), marked("behind"),
    marked("behind left"), marked("the left"), marked("the front left"),
)  # fmt: skip
# elevations from which each begins; phones held by hand around a thing on a table reach −15° to 60°
BANDS = (
    (-90.0, marked("below")),
    (-15.0, marked("at its height")),
    (30.0, marked("above")),
    (60.0, marked("steeply above")),
)


@dataclass(frozen=True)
class Layout:
    """Where N cameras stand, seen from the front. See `CaptureReport` and `PhotoFacts` for the fields.

    around: degrees of azimuth from the first to the last photo, over the side where photos are.
    """

    kind: Kind
    center: np.ndarray
    axes: np.ndarray
    front: int
    positions: np.ndarray
    forwards: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    distance: np.ndarray
    off_centre: np.ndarray
    around: float
    middle: float
    spread: float


def layout(scene: Scene, train: np.ndarray) -> Layout:
    """Describe how the cameras of a scene stand; the training photos (indices `train`) decide."""
    poses = scene.poses
    places, looks, up = poses[:, :, 3], -poses[:, :, 2], scene.up / np.linalg.norm(scene.up)
    mean = looks[train].mean(0)
    spread = float(np.percentile(angles(looks[train], mean), 95)) if np.linalg.norm(mean) > 1e-3 else 180.0
    center, kind = np.array(scene.center, np.float64), _kind(scene, places[train], looks[train], spread)
    if kind == "free":
        center = places[train].mean(0)
    out = -mean if kind in ("forward-facing", "single") else (places[train] - center).mean(0)
    e1, e2, up = horizontal_axes(up)
    flat = np.array([out @ e1, out @ e2])
    scale = 1.0 if kind in ("forward-facing", "single") else np.linalg.norm(places[train] - center, axis=1).mean()
    front = -1
    if np.linalg.norm(flat) < CLEAR * max(float(scale), 1e-12) or not np.isfinite(flat).all():
        front = int(train[0])
        flat = np.array([(places[front] - center) @ e1, (places[front] - center) @ e2])
        if kind == "free" or np.linalg.norm(flat) < 1e-9:
            flat = np.array([-looks[front] @ e1, -looks[front] @ e2])
    if np.linalg.norm(flat) < 1e-9:
        flat = np.array([1.0, 0.0])
    flat = flat / np.linalg.norm(flat)
    if front < 0 and kind in ("around", "one-sided"):  # a photo gives the front a name
        offsets = places[train] - center
        level = np.stack([offsets @ e1, offsets @ e2], -1)
        cosine = level @ flat / np.maximum(np.linalg.norm(level, axis=1), 1e-12)
        front = int(train[int(np.argmax(cosine))])
        flat = level[int(np.argmax(cosine))] / max(np.linalg.norm(level[int(np.argmax(cosine))]), 1e-12)
    away = -(flat[0] * e1 + flat[1] * e2)
    axes = np.stack([np.cross(away, up), away, up])
    return _seen_from_the_front(kind, center, axes, front, places, looks, train, spread)


def _seen_from_the_front(
    kind: Kind,
    center: np.ndarray,
    axes: np.ndarray,
    front: int,
    places: np.ndarray,
    looks: np.ndarray,
    train: np.ndarray,
    spread: float,
) -> Layout:
    positions, forwards = (places - center) @ axes.T, looks @ axes.T
    distance = np.linalg.norm(positions, axis=1)
    azimuth = np.degrees(np.arctan2(positions[:, 0], -positions[:, 1]))
    elevation = np.degrees(np.arcsin(np.clip(positions[:, 2] / np.maximum(distance, 1e-12), -1, 1)))
    start, gap = _largest_hole(azimuth[train][elevation[train] < STEEP])
    if kind == "around" and gap > 360 - HALF_ROUND:
        kind = "one-sided"
    middle = ((start + gap + (360 - gap) / 2) + 180) % 360 - 180
    towards = np.degrees(np.arccos(np.clip((-positions * forwards).sum(1) / np.maximum(distance, 1e-12), -1, 1)))
    return Layout(
        kind, center, axes, front, positions, forwards, azimuth, elevation, distance, towards, 360 - gap, middle, spread
    )


def _kind(scene: Scene, places: np.ndarray, looks: np.ndarray, spread: float) -> Kind:
    if len(places) == 1:
        return "single"
    if scene.ndc is not None or spread <= ONE_WAY:
        return "forward-facing"
    off = angles(scene.center - places, looks)
    return "around" if (off < TOWARDS).mean() >= INWARD else "free"


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles in degrees between vectors (…, 3); 90 where one has no length."""
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(np.clip((a * b).sum(-1) / np.maximum(lengths, 1e-12), -1, 1)))


def _largest_hole(azimuth: np.ndarray) -> tuple[float, float]:
    """Where the largest gap between azimuths begins, and its width, in degrees."""
    if len(azimuth) < 2:
        return (float(azimuth[0]) if len(azimuth) else 0.0), 360.0
    ordered = np.sort(azimuth)
    gaps = np.diff(np.append(ordered, ordered[0] + 360))
    k = int(np.argmax(gaps))
    return float(ordered[k]), float(gaps[k])


# ---- neighbours -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Near:
    """The neighbours of N photos among the training photos, and what they say. See `PhotoFacts`.

    similar: (N, K) indices of the K most similar views, the most similar first.
    twins: pairs of photos whose cameras are the same.
    """

    similar: np.ndarray
    separation: np.ndarray
    by_place: np.ndarray
    place_distance: np.ndarray
    twins: tuple[tuple[int, int], ...]


def separations(where: Layout, depth: np.ndarray, k: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how many degrees other views differ from view k, and how far from it they were taken.

    The difference is the larger of two angles: between the optical axes, and that between the two places as seen from
    the content, arctan(distance / depth). depth: (N,) from each camera to the middle of what it shows.
    """
    apart = np.linalg.norm(where.positions[others] - where.positions[k], axis=1)
    seen = np.degrees(np.arctan2(apart, np.minimum(depth[others], depth[k])))
    cosine = np.clip(where.forwards[others] @ where.forwards[k], -1, 1)
    return np.maximum(np.degrees(np.arccos(cosine)), seen), apart


def neighbours(where: Layout, depth: np.ndarray, train: np.ndarray) -> Generator[None, None, Near]:
    """Find each photo's neighbours; yields after every photo."""
    count = len(where.positions)
    most = min(NEIGHBOURS, max(len(train) - 1, 1))
    similar, separation = np.full((count, most), -1), np.full(count, np.nan)
    by_place, place_distance, twins = np.full(count, -1), np.full(count, np.nan), []
    for k in range(count):
        others = train[train != k]
        if len(others):
            differ, apart = separations(where, depth, k, others)
            near = np.flatnonzero(differ <= np.partition(differ, most - 1)[most - 1])  # all that may be among the first
            order = near[np.argsort(differ[near], kind="stable")][:most]
            similar[k, : len(order)] = others[order]
            separation[k], at = differ[order[0]], int(np.argmin(apart))
            by_place[k], place_distance[k] = others[at], apart[at]
            # a hundredth of a degree is less than any tripod or solver repeats
            twins += [(k, int(j)) for j in others[(differ < 0.01) & (apart < 1e-4 * depth[k])] if j > k]
        yield
    return Near(similar, separation, by_place, place_distance, tuple(twins))


# ---- gaps -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Covered:
    """Which directions around the centre have a photo near. See `CaptureReport`."""

    azimuths: np.ndarray
    heights: np.ndarray
    uncovered: np.ndarray
    gaps: tuple[Gap, ...]


NOTHING = Covered(np.zeros(0), np.zeros(0), np.zeros((0, 0), bool), ())


def coverage(where: Layout, train: np.ndarray) -> Covered:
    """Find the gaps between photos that stand around something.

    Only heights at which photos were taken count, and of a capture from one side only that side: nobody who walked
    around a thing at one height has missed anything from above.
    """
    if where.kind not in ("around", "one-sided"):
        return NOTHING
    low, high = np.percentile(where.elevation[train], (2, 98))  # one photo from the top does not ask for more there
    heights = np.linspace(low, high, max(1, math.ceil((high - low) / CELL)) + 1) if high > low else np.array([low])
    first, last = (-180.0, 180.0)
    if where.kind == "one-sided":
        first, last = where.middle - where.around / 2, where.middle + where.around / 2
    azimuths = np.arange(first + CELL / 2, last, CELL)
    seen = directions(where.azimuth[train], where.elevation[train])
    grid = directions(azimuths[:, None], heights[None, :])
    nearest = (grid.reshape(-1, 3) @ seen.T).max(1).reshape(grid.shape[:2])
    uncovered = nearest < math.cos(math.radians(FAR_DEGREES))
    return Covered(azimuths, heights, uncovered, _gaps(azimuths, heights, uncovered, where.kind == "around"))


def directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return unit vectors (…, 3), right, away and up, from angles in degrees."""
    a, e = np.broadcast_arrays(np.radians(azimuth), np.radians(elevation))
    return np.stack([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)], -1)


def _gaps(azimuths: np.ndarray, heights: np.ndarray, uncovered: np.ndarray, closed: bool) -> tuple[Gap, ...]:
    found: dict[tuple[str, str], list[tuple[float, float, float, float, str]]] = {}
    edges = [begin for begin, _ in BANDS[1:]]
    for band, (_, height) in enumerate(BANDS):
        rows = np.searchsorted(edges, heights, side="right") == band
        if not rows.any():
            continue
        low, high = float(heights[rows].min()), float(heights[rows].max())
        # where half of a band's heights have a photo near, the neighbouring band tells of the rest
        for first, last in _runs(azimuths, uncovered[:, rows].mean(1) >= 0.5, closed):
            sides = _side(first + 22.5), _side(last - 22.5)
            if last - first < 67.5:
                sides = _side((first + last) / 2), _side((first + last) / 2)
            found.setdefault(sides, []).append((first, last, low, high, height))
    gaps = []
    for (one, other), parts in found.items():
        first, last = min(p[0] for p in parts), max(p[1] for p in parts)
        where = one if one == other else phrase("{first} round to {last}", first=phrase(one), last=phrase(other))
        if last - first >= 360:
            where = phrase("all around")
        height = phrase(parts[0][4])
        if len(parts) > 1:
            height = phrase("{low} to {high}", low=height, high=phrase(parts[-1][4]))
        text = phrase("{where}, {height}", where=where if one != other else phrase(one), height=height)
        gaps.append(Gap(first, last, min(p[2] for p in parts), max(p[3] for p in parts), text))
    return tuple(sorted(gaps, key=lambda gap: -gap.width))


def _side(azimuth: float) -> str:
    return SIDES[round(azimuth / 45) % 8]


def _runs(azimuths: np.ndarray, missing: np.ndarray, closed: bool) -> list[tuple[float, float]]:
    """First and last azimuth of each run of columns without a photo near, at least LEAST_COLUMNS wide."""
    if missing.all():
        return [(float(azimuths[0] - CELL / 2), float(azimuths[-1] + CELL / 2))]
    begin = int(np.argmin(missing)) if closed else 0  # at a column that is covered, so that no run is cut in two
    order = np.roll(np.arange(len(missing)), -begin)
    runs: list[tuple[float, float]] = []
    length = 0
    for place, column in enumerate([*order, -1]):
        if column >= 0 and missing[column]:
            length += 1
            continue
        if length >= LEAST_COLUMNS:
            first = float(azimuths[order[place - length]] - CELL / 2)
            runs.append((first, first + CELL * length))
        length = 0
    return runs
