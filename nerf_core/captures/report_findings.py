"""What the measurements of a capture mean: photos that stand out, what limits the quality, what to photograph next."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerf_core.captures.report_records import Finding, Gap, PhotoFacts
from nerf_core.captures.report_views import FAR_DEGREES, Covered, Layout, Near, directions
from nerf_core.common.language import digits, phrase, phrases
from nerf_core.common.text import number
from nerf_core.datasets.calibration import oddities
from nerf_core.geometry.scene import Scene

# The robust z-score 0.6745 (x − median) / MAD, and its limit, are those of Iglewicz & Hoaglin, How to detect and handle
# outliers, 1993. The floors below keep a set that is very even, a rendered one say, from having outliers of nothing.
Z_FACTOR, Z_LIMIT = 0.6745, 3.5
# of the sharpness of similar views: less is seen at once when both photos are flipped between; a blur with a deviation
# of 0.7 pixels gives it in a sharp photo
SOFT = 0.7
OFF_STOPS = 0.5  # more than the steps of a camera's exposure, 1/3, and seen at once
OFF_RENDERED = 1.0  # rendered photos have one exposure; what differs is what they show
OFF_DISTANCE = 2.0  # times the usual distance: half or double the detail
OFF_CENTRE = 60.0  # degrees: outside of the picture of any lens but a fisheye
OFF_FOCAL = 0.05  # of the usual field of view: solvers repeat it to 1 % or better, and zooms move it by more
CLIPPED = 0.25  # of the pixels: a quarter of the picture without detail
FEW = 20  # the least that a scene of LLFF's captures has
WIDE_STEP = 20.0  # degrees between neighbours: guides to photogrammetry ask for 10° to 15°
STEP = 12.0  # degrees between photos that are advised: 30 for a ring
DRIFT = 0.3  # stops: the usual step of exposure between neighbours, in a capture with a fixed one under 0.1
BLURRED_ALL = 0.18  # sharpness of the usual photo: that of one that was enlarged by 2 or more
SMALL = 400  # pixels of the longer side: half of the 800 of NeRF's synthetic scenes
PRINCIPAL = 0.05  # image sizes from the centre: phones have 0.01, cropped photos more
# What one affected photo, or one missed direction, weighs. A wrong pose or lens contradicts all other photos; where no
# photo looks, a model has to guess; a soft or dark photo only blurs or clouds what others show as well.
POSES, COVERAGE, LOOKS = 3.0, 2.0, 1.0
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


# ---- photos that stand out --------------------------------------------------------------------------------------


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
    away = (robust_z(where.off_centre, 1.0) > Z_LIMIT) & (where.off_centre > OFF_CENTRE)
    view = np.array([p.field_of_view for p in photos])
    for k, p in enumerate(photos):
        if p.separation > FAR_DEGREES:
            text = phrase("no similar view: the nearest is {angle:.0f}° away", angle=p.separation)
            tell("alone", k, text)
        if facts.inward and odd_distance[k]:
            times = p.distance / float(np.median(where.distance))
            text = phrase("{times:.2g} times as far from the centre as most: a close-up, or a wrong pose", times=times)
            tell("distance", k, text)
        if facts.inward and away[k]:
            text = phrase("looks {angle:.0f}° past the centre: its pose may be wrong", angle=p.off_centre)
            tell("pose", k, text)
        if abs(view[k] / np.median(view) - 1) > OFF_FOCAL:
            tell("focal", k, phrase("a field of view of {angle:.0f}°, unlike the others", angle=view[k]))
    for one, other in facts.near.twins:
        for k, twin in ((one, other), (other, one)):
            if not any(text.startswith("has the same pose") for text in ()):
                tell("twin", k, phrase("has the same pose as {name}", name=photos[twin].name))


def names(facts: Facts, indices: Sequence[int]) -> str:
    """Return the first few names, and how many more there are, as a phrase."""
    shown = ", ".join(facts.photos[k].name for k in indices[:SHOWN_NAMES])
    more = len(indices) - SHOWN_NAMES
    return phrases("{names} and {n} more", "{names} and {n} more", more, names=shown) if more > 0 else shown


# ---- the capture as a whole -------------------------------------------------------------------------------------


def summary(facts: Facts) -> str:
    """Return a sentence on how the cameras stand."""
    where, train = facts.where, facts.train
    elevation = where.elevation[train]
    count = phrases("{n:,} training photo", "{n:,} training photos", len(train))
    angles = {"around": where.around, "low": whole(elevation.min()), "high": whole(elevation.max())}
    front = facts.photos[where.front].name if where.front >= 0 else ""
    if where.kind == "around":
        return phrase(
            "{count} all around, at elevations from {low} to {high}. The front is where {front} was taken.",
            count=count, front=front, **angles,
        )  # fmt: skip
    if where.kind == "one-sided":
        return phrase(
            "{count} from one side: over {around:.0f}° around the centre, at elevations from {low} to {high}. The "
            "front is the middle, where {front} was taken.",
            count=count, front=front, **angles,
        )  # fmt: skip
    if where.kind == "forward-facing":
        wide, high = _window(facts)
        return phrase(
            "{count} that look one way, from a window of {wide} × {high} units. Only this side is meant, so that "
            "there are no gaps to look for: views from beside or behind it cannot be shown.",
            count=count, wide=number(wide, 2), high=number(high, 2),
        )  # fmt: skip
    if where.kind == "single":
        return phrase("One training photo: depth cannot be learnt from it.")
    return phrase(
        "{count} that look in many directions from among what they show, as in a room. Gaps around a centre are not "
        "looked for.",
        count=count,
    )


def whole(degrees: float) -> str:
    """Return an angle in whole degrees, with a real minus sign, as a phrase."""
    return digits(f"{round(degrees):d}°".replace("-", "−"))


def _window(facts: Facts) -> tuple[float, float]:
    """Width and height of where the training cameras of a forward-facing capture stand, in scene units."""
    places = facts.where.positions[facts.train]
    return float(np.ptp(places[:, 0])), float(np.ptp(places[:, 2]))


def calibration(facts: Facts) -> tuple[str, ...]:
    """Return what the cameras' calibration is, a line each: oddities first."""
    cameras = [view.camera for view in facts.scene.views]
    lines = oddities(cameras)
    fov = np.array([p.field_of_view for p in facts.photos])
    spread = float(fov.max() / max(fov.min(), 1e-9) - 1)
    if spread <= 0.001:
        lines.append(phrase("one field of view for all photos: {angle:.1f}° across", angle=fov[0]))
    else:
        lines.append(
            phrase(
                "fields of view from {low:.1f}° to {high:.1f}° across: each photo has its own calibration, or the lens "
                "was zoomed",
                low=fov.min(),
                high=fov.max(),
            )
        )
    shift = max(max(abs(c.cx / c.width - 0.5), abs(c.cy / c.height - 0.5)) for c in cameras)
    if shift > PRINCIPAL:
        lines.append(
            phrase("principal point {share:.0%} of the picture off its middle: cropped photos, or wrong", share=shift)
        )
    square = max(abs(c.fx / c.fy - 1) for c in cameras)
    if square > 0.02:  # lenses for cinema apart, pixels are square, and solvers find that to 1 %
        lines.append(phrase("pixels are not square: fx and fy differ by {share:.1%}", share=square))
    bent = sum(c.lens.bends for c in cameras)
    if bent:
        lines.append(phrases("lens distortion in {n:,} photo", "lens distortion in {n:,} photos", bent))
    else:
        lines.append(phrase("no lens distortion: undistorted or rendered photos"))
    return tuple(lines)


# ---- what limits the quality ------------------------------------------------------------------------------------


def limits(facts: Facts, odd: dict[str, tuple[int, ...]]) -> tuple[Finding, ...]:
    """Return what limits the quality, the worst first: by the share of photos or directions times its weight."""
    found = [*_limits_of_places(facts, odd), *_limits_of_looks(facts, odd), *_limits_of_calibration(facts, odd)]
    return tuple(sorted(found, key=lambda one: -one.score))


def _limits_of_places(facts: Facts, odd: dict[str, tuple[int, ...]]) -> list[Finding]:
    found, count, where = [], len(facts.photos), facts.where
    for gap in facts.covered.gaps:
        missed = gap.width / 360 * max(gap.high - gap.low, 30.0) / 60  # of a band of 60°, as objects are looked at
        text = phrase(
            "no photo from {where} ({width:.0f}° wide): what shows only from there is guessed",
            where=gap.text, width=gap.width,
        )  # fmt: skip
        found.append(Finding("gap", COVERAGE * min(missed + 0.1, 1.0), text))
    if where.kind == "one-sided":
        text = phrase(
            "photos cover {around:.0f}° of 360° around the centre: the other side is missing, unless it is not meant",
            around=where.around,
        )
        found.append(Finding("one-sided", COVERAGE * 0.1, text))
    steps = np.array([facts.photos[k].separation for k in facts.train])
    wide = len(steps) < 2 or float(np.median(steps)) > STEP  # a few photos side by side are enough for a small window
    if len(facts.train) < FEW and wide:
        text = phrases(
            "only {n} training photo: captures of this kind have {few} to 100",
            "only {n} training photos: captures of this kind have {few} to 100",
            len(facts.train), few=FEW,
        )  # fmt: skip
        found.append(Finding("few", COVERAGE * (1 - len(facts.train) / FEW), text, phrase("add photos in between")))
    if len(steps) > 1 and np.median(steps) > WIDE_STEP:
        text = phrase(
            "neighbouring photos differ by {step:.0f}°, where 10° to 15° are usual: surfaces are uncertain",
            step=float(np.median(steps)),
        )
        found.append(Finding("steps", COVERAGE * min(float(np.median(steps)) / 90, 1.0), text))
    alone = [k for k in odd.get("alone", ()) if facts.photos[k].split in ("train", "")]
    if alone:
        text = phrases(
            "{n} photo has no other within {far:.0f}°: {names}",
            "{n} photos have no other within {far:.0f}°: {names}",
            len(alone), far=FAR_DEGREES, names=names(facts, alone),
        )  # fmt: skip
        found.append(Finding("alone", COVERAGE * len(alone) / count, text, phrase("add photos beside"), tuple(alone)))
    held = [k for k in odd.get("alone", ()) if facts.photos[k].split not in ("train", "")]
    if held:
        text = phrases(
            "{n} held-out photo is farther than {far:.0f}° from every training photo: it measures guesses",
            "{n} held-out photos are farther than {far:.0f}° from every training photo: they measure guesses",
            len(held), far=FAR_DEGREES,
        )  # fmt: skip
        found.append(Finding("held out", LOOKS * len(held) / count, text, photos=tuple(held)))
    return found + _limits_of_poses(facts, odd)


def _limits_of_poses(facts: Facts, odd: dict[str, tuple[int, ...]]) -> list[Finding]:
    found, count = [], len(facts.photos)
    if odd.get("pose"):
        text = phrases(
            "{n} photo looks past the centre: {names}",
            "{n} photos look past the centre: {names}",
            len(odd["pose"]), names=names(facts, odd["pose"]),
        )  # fmt: skip
        advice = phrase("check the poses, or leave these photos out")
        found.append(Finding("pose", POSES * len(odd["pose"]) / count, text, advice, odd["pose"]))
    if odd.get("distance"):
        text = phrases(
            "{n} photo stands far nearer or farther than most: {names}",
            "{n} photos stand far nearer or farther than most: {names}",
            len(odd["distance"]), names=names(facts, odd["distance"]),
        )  # fmt: skip
        found.append(Finding("distance", LOOKS * len(odd["distance"]) / count, text, photos=odd["distance"]))
    twins = tuple(dict.fromkeys(odd.get("twin", ())))
    if twins:
        text = phrases(
            "{n} photo has the pose of another: {names}",
            "{n} photos have the pose of another: {names}",
            len(twins), names=names(facts, twins),
        )  # fmt: skip
        advice = phrase("a tripod is fine; if the pictures differ, a pose is wrong")
        found.append(Finding("twin", LOOKS * len(twins) / count, text, advice, twins))
    return found


def _limits_of_looks(facts: Facts, odd: dict[str, tuple[int, ...]]) -> list[Finding]:
    found, photos = [], facts.photos
    texts = {
        "blank": ("{n} photo shows nothing: {names}", "{n} photos show nothing: {names}"),
    }
    for kind, indices in odd.items():
        if kind == "blank":
            text = phrases("{n} photo shows nothing: {names}", "{n} photos show nothing: {names}", len(indices),
                           names=names(facts, indices))  # fmt: skip
            advice = phrase("leave out or take again")
        elif kind == "soft":
            text = phrases("{n} photo is blurred: {names}", "{n} photos are blurred: {names}", len(indices),
                           names=names(facts, indices))  # fmt: skip
            advice = phrase("leave out or take again")
        elif kind == "exposure":
            text = phrases("{n} photo is exposed unlike its neighbours: {names}",
                           "{n} photos are exposed unlike their neighbours: {names}", len(indices),
                           names=names(facts, indices))  # fmt: skip
            advice = phrase("leave out, or even out the brightness")
        elif kind == "clipped":
            text = phrases("{n} photo is overexposed: {names}", "{n} photos are overexposed: {names}", len(indices),
                           names=names(facts, indices))  # fmt: skip
            advice = phrase("leave out or take again")
        else:
            continue
        found.append(Finding(kind, LOOKS * len(indices) / len(photos), text, advice, indices))
    del texts
    steps = np.abs([p.relative_exposure for p in photos if np.isfinite(p.relative_exposure)])
    if len(steps) > 2 and np.median(steps) > DRIFT:
        text = phrase(
            "the exposure changes from photo to photo, by {stops:.1f} stops as a rule: clouds of haze explain it",
            stops=float(np.median(steps)),
        )
        found.append(Finding("drift", LOOKS * 0.5, text, phrase("lock the exposure")))
    return found + _limits_of_pixels(facts)


def _limits_of_pixels(facts: Facts) -> list[Finding]:
    found, photos = [], facts.photos
    sharp = np.array([p.sharpness for p in photos])
    if np.isfinite(sharp).any() and np.nanmedian(sharp) < BLURRED_ALL:
        text = phrase(
            "all photos are soft at this size: their finest detail has {share:.0%} of the contrast that sharp photos "
            "have",
            share=float(np.nanmedian(sharp)),
        )
        found.append(Finding("soft all", LOOKS * 0.3, text, phrase("--downscale 2 loses nothing and is faster")))
    longest = float(np.median([max(p.size) for p in photos]))
    if longest < SMALL:
        text = phrase("photos are {pixels:.0f} pixels long: finer detail than that is not in them", pixels=longest)
        found.append(Finding("small", LOOKS * 0.2, text, phrase("load larger photos")))
    return found


def _limits_of_calibration(facts: Facts, odd: dict[str, tuple[int, ...]]) -> list[Finding]:
    advice = phrase("calibrate again, with one camera for all photos")
    found = [
        Finding("calibration", POSES * 0.5, text, advice) for text in oddities([v.camera for v in facts.scene.views])
    ]
    focal = odd.get("focal", ())
    if focal:
        text = phrases(
            "{n} photo has another field of view than most: {names}",
            "{n} photos have another field of view than most: {names}",
            len(focal), names=names(facts, focal),
        )  # fmt: skip
        advice = phrase("right for a zoom or another camera; else the calibration is wrong")
        found.append(Finding("focal", LOOKS * len(focal) / len(facts.photos), text, advice, focal))
    return found


# ---- what to photograph next ------------------------------------------------------------------------------------


def advise(facts: Facts) -> tuple[str, ...]:
    """Return what to photograph next, the most useful first; a sentence each."""
    where = facts.where
    said = [_for_gap(facts, gap) for gap in facts.covered.gaps]
    again = [k for k, p in enumerate(facts.photos) if _bad(p)]
    if again:
        text = phrases("Take {n} photo again: {names}.", "Take {n} photos again: {names}.", len(again),
                       names=names(facts, again))  # fmt: skip
        said.append(text)
    steps = [facts.photos[k].separation for k in facts.train]
    if len(steps) > 1 and np.median(steps) > (STEP if len(facts.train) < FEW else WIDE_STEP):
        text = phrase("Add photos between those that there are, a step of {step:.0f}° apart at most.", step=STEP)
        said.append(text)
    if where.kind == "one-sided":
        least = math.ceil((360 - where.around) / (1.5 * STEP))
        text = phrase(
            "If the whole thing is meant, go on round it: {least} to {most} photos from the right over behind to the "
            "left, at an elevation of about {height}.",
            least=least, most=math.ceil(1.5 * least), height=whole(np.median(where.elevation[facts.train])),
        )  # fmt: skip
        said.append(text)
    if where.kind == "forward-facing":
        wide, high = _window(facts)
        text = phrase(
            "To move farther in films, widen the window: photos from up to {wide} units more to the left and right, "
            "and {high} up and down.",
            wide=number(wide / 2, 2), high=number(high / 2, 2),
        )  # fmt: skip
        said.append(text)
    if facts.inward and where.elevation[facts.train].max() < 45:
        text = phrase(
            "Only to look down from above: {least} to {most} photos at elevations of 50° to 60°.", least=6, most=10
        )
        said.append(text)
    return tuple(said)


def _bad(p: PhotoFacts) -> bool:
    return math.isnan(p.sharpness) or any(" as sharp as " in text or "clipped" in text for text in p.odd)


def _for_gap(facts: Facts, gap: Gap) -> str:
    """Say how many photos a gap needs, at what height, and where to begin."""
    least = max(2, math.ceil(gap.width / (1.5 * STEP)))
    height = (gap.low + gap.high) / 2
    towards = directions(np.array((gap.first + gap.last) / 2), np.array(height))
    where, train = facts.where, facts.train
    like = int(train[int(np.argmin(np.abs(where.elevation[train] - height)))])
    beside = int(train[int(np.argmax(directions(where.azimuth[train], where.elevation[train]) @ towards))])
    return phrase(
        "Add {least} to {most} photos from {where}: at an elevation of about {height}, as {like} has; begin beside "
        "{beside}.",
        least=least, most=math.ceil(1.5 * least), where=gap.text, height=whole(height),
        like=facts.photos[like].name, beside=facts.photos[beside].name,
    )  # fmt: skip
