"""Photos of a capture that stand out from the others, with a sentence on each reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerf_core.captures.report_records import PhotoFacts
from nerf_core.captures.report_views import FAR_DEGREES, Covered, Layout, Near, angles
from nerf_core.common.language import phrase, phrases
from nerf_core.datasets.rig import common_focus
from nerf_core.geometry.scene import Scene

# The robust z-score 0.6745 (x − median) / MAD, and its limit, are those of Iglewicz & Hoaglin, How to detect and handle
# outliers, 1993. The floors below keep a set that is very even, a rendered one say, from having outliers of nothing.
Z_FACTOR, Z_LIMIT = 0.6745, 3.5
# of the sharpness of similar views: a blur with a deviation of 0.5 pixels gives it in a sharp photo (of fern), of 1
# pixel in one that is soft already (of fox); neighbours differ by 0.75 to 1.25 without any fault
SOFT = 0.7
OFF_STOPS = 0.67  # two steps of a camera's exposure; similar views differ by up to 0.5 because of what they show
OFF_RENDERED = 1.0  # rendered photos have one exposure; what differs is what they show
OFF_DISTANCE = 2.0  # times the usual distance: half or double the detail
OFF_CENTRE = 60.0  # degrees: outside of the picture of any lens but a fisheye
ONE_CENTRE = 20.0  # degrees: in a room, half of the optical axes pass any one place by more than that
OFF_FOCAL = 0.05  # of the usual field of view: solvers repeat it to 1 % or better, and zooms move it by more
CLIPPED = 0.25  # of the pixels: a quarter of the picture without detail
SHOWN_NAMES = 3  # of the photos of a finding: the table has all


@dataclass(frozen=True)
class Facts:
    """What is known of a capture when findings are made.

    train: the indices of training photos. depth: see `report_views.separations`.
    """

    scene: Scene
    photos: tuple[PhotoFacts, ...]
    where: Layout
    near: Near
    train: np.ndarray
    covered: Covered
    depth: np.ndarray

    @property
    def inward(self) -> bool:
        return self.where.kind in ("around", "one-sided")


def robust_z(values: np.ndarray, floor: float) -> np.ndarray:
    """Return how far each value (N,) lies from the median in robust standard deviations; NaN values have 0.

    floor: the least median absolute deviation that is taken.
    """
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(len(values))
    away = values - np.median(values[known])
    return np.where(known, Z_FACTOR * away / max(float(np.median(np.abs(away[known]))), floor), 0.0)


def odd_ones(facts: Facts) -> tuple[tuple[PhotoFacts, ...], dict[str, tuple[int, ...]]]:
    """Return the photos with a sentence for each oddity, and the indices of those that have it, by its kind."""
    found: dict[str, list[int]] = {}
    said: list[list[str]] = [[] for _ in facts.photos]

    def tell(kind: str, k: int, text: str) -> None:
        found.setdefault(kind, []).append(k)
        said[k].append(text)

    _odd_looks(facts, tell)
    _odd_places(facts, tell)
    photos = tuple(replace(one, odd=tuple(texts)) for one, texts in zip(facts.photos, said, strict=True))
    return photos, {kind: tuple(indices) for kind, indices in found.items()}


Tell = Callable[[str, int, str], None]


def _odd_looks(facts: Facts, tell: Tell) -> None:
    photos = facts.photos
    relative = np.array([p.relative_sharpness for p in photos])
    with np.errstate(invalid="ignore", divide="ignore"):
        soft = robust_z(np.log2(relative), 0.03) < -Z_LIMIT
    light = np.array([p.relative_exposure for p in photos])
    off = np.abs(robust_z(light, 0.05)) > Z_LIMIT
    clipped = np.array([p.highlights for p in photos])
    burnt = (robust_z(clipped, 0.01) > Z_LIMIT) & (clipped > CLIPPED)
    for k, p in enumerate(photos):
        if math.isnan(p.sharpness):
            tell("blank", k, phrase("shows nothing: its pixels are all alike"))
        elif soft[k] and relative[k] < SOFT:
            text = phrase("{share:.0%} as sharp as similar views: motion, or out of focus", share=relative[k])
            tell("soft", k, text)
        if off[k] and abs(light[k]) > (OFF_RENDERED if facts.scene.synthetic else OFF_STOPS):
            if light[k] < 0:
                text = phrase("{stops:.1f} stops darker than similar views", stops=-light[k])
            else:
                text = phrase("{stops:.1f} stops brighter than similar views", stops=light[k])
            tell("exposure", k, text)
        if burnt[k]:
            tell("clipped", k, phrase("{share:.0%} of its pixels are clipped: overexposed", share=clipped[k]))


def _odd_places(facts: Facts, tell: Tell) -> None:
    photos, where = facts.photos, facts.where
    far = np.log2(np.maximum(where.distance, 1e-12))
    odd_distance = (np.abs(robust_z(far, 0.03)) > Z_LIMIT) & (np.abs(far - np.median(far)) > math.log2(OFF_DISTANCE))
    past, away = _past_centre(facts)
    view = np.array([p.field_of_view for p in photos])
    for k, p in enumerate(photos):
        if p.separation > FAR_DEGREES:
            text = phrase("no similar view: the nearest is {angle:.0f}° away", angle=p.separation)
            tell("alone", k, text)
        if facts.inward and odd_distance[k]:
            times = p.distance / float(np.median(where.distance))
            text = phrase("{times:.2g} times as far from the centre as most: a close-up, or a wrong pose", times=times)
            tell("distance", k, text)
        if away[k]:
            text = phrase("looks {angle:.0f}° past the centre: its pose may be wrong", angle=past[k])
            tell("pose", k, text)
        if abs(view[k] / np.median(view) - 1) > OFF_FOCAL:
            tell("focal", k, phrase("a field of view of {angle:.0f}°, unlike the others", angle=view[k]))
    for one, other in facts.near.twins:
        for k, twin in ((one, other), (other, one)):
            tell("twin", k, phrase("has the same pose as {name}", name=photos[twin].name))


def _past_centre(facts: Facts) -> tuple[np.ndarray, np.ndarray]:
    """Angles (N,) in degrees by which photos look past the centre, and which of them (N,) do so unlike the others.

    If a third of the poses is wrong, the cameras count as free, and have no centre. Then it is the point that half of
    them look at, if there is one.
    """
    off, known = facts.where.off_centre, facts.inward
    if facts.where.kind == "free":
        poses = facts.scene.poses
        focus = common_focus(poses[facts.train], 0.5)
        if focus is not None:
            off = angles(focus - poses[:, :, 3], -poses[:, :, 2])
            known = float(np.median(off[facts.train])) < ONE_CENTRE
    return off, known & (robust_z(off, 1.0) > Z_LIMIT) & (off > OFF_CENTRE)


def names(facts: Facts, indices: Sequence[int]) -> str:
    """Return the first few names, and how many more there are, as a phrase."""
    shown = ", ".join(facts.photos[k].name for k in indices[:SHOWN_NAMES])
    more = len(indices) - SHOWN_NAMES
    return phrases("{names} and {n} more", "{names} and {n} more", more, names=shown) if more > 0 else shown
