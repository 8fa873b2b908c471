"""What limits the quality of a capture, ranked."""

from __future__ import annotations

import numpy as np

from nerf_core.captures.report_advice import FEW, STEP, WIDE_STEP
from nerf_core.captures.report_odd import Facts, names
from nerf_core.captures.report_records import Finding
from nerf_core.captures.report_views import FAR_DEGREES
from nerf_core.common.language import phrase, phrases
from nerf_core.datasets.calibration import oddities

DRIFT = 0.3  # stops: the usual step of exposure between neighbours, in a capture with a fixed one under 0.1
# sharpness of the usual photo. Photos of fox and can have 0.26 and 0.28: halved and enlarged again, they keep 44 dB,
# and so nearly all that is in them. Those of lego have 0.45 and 34 dB, those of fern 0.78 and 26 dB.
SOFT_ALL = 0.3
SMALL = 400  # pixels of the longer side: half of the 800 of NeRF's synthetic scenes
# What one affected photo, or one missed direction, weighs. A wrong pose or lens contradicts all other photos; where no
# photo looks, a model has to guess; a soft or dark photo only blurs or clouds what others show as well.
POSES, COVERAGE, LOOKS = 3.0, 2.0, 1.0


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
        found.append(Finding("gap", COVERAGE * min(missed + 0.1, 1.0), text, phrase("add photos from there")))
    if where.kind == "one-sided":
        text = phrase(
            "photos cover {around:.0f}° of 360° around the centre, so the other side cannot be shown",
            around=where.around,
        )
        advice = phrase("train it if this side is enough; else add photos of the other side")
        found.append(Finding("one-sided", COVERAGE * 0.1, text, advice))
    steps = np.array([facts.photos[k].separation for k in facts.train])
    wide = len(steps) < 2 or float(np.median(steps)) > STEP  # a few photos side by side are enough for a small window
    if len(facts.train) < FEW and wide:
        text = phrases(
            "only {n} training photo: captures of this kind have {few} to 100",
            "only {n} training photos: captures of this kind have {few} to 100",
            len(facts.train), few=FEW,
        )  # fmt: skip
        one = len(facts.train) == 1
        advice = phrase("add photos from other places") if one else phrase("add photos in between")
        found.append(Finding("few", COVERAGE * (1 - len(facts.train) / FEW), text, advice))
    if len(steps) > 1 and np.median(steps) > WIDE_STEP:
        text = phrase(
            "neighbouring photos differ by {step:.0f}°, where 10° to 15° are usual: surfaces are uncertain",
            step=float(np.median(steps)),
        )
        score = COVERAGE * min(float(np.median(steps)) / 90, 1.0)
        found.append(Finding("steps", score, text, phrase("add photos in between")))
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
        advice = phrase("add training photos beside, or hold out other ones")
        found.append(Finding("held out", LOOKS * len(held) / count, text, advice, tuple(held)))
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
        advice = phrase("check the poses, unless these are close-ups")
        found.append(Finding("distance", LOOKS * len(odd["distance"]) / count, text, advice, odd["distance"]))
    twins = tuple(dict.fromkeys(odd.get("twin", ())))
    if twins:
        text = phrases(
            "{n} photo has the pose of another: {names}",
            "{n} photos have the pose of another: {names}",
            len(twins), names=names(facts, twins),
        )  # fmt: skip
        advice = phrase("check the poses, unless the camera stood on a tripod")
        found.append(Finding("twin", LOOKS * len(twins) / count, text, advice, twins))
    return found


def _of_looks(kind: str, n: int, who: str) -> tuple[str, str]:
    """What was found in n photos, and what to do."""
    again = phrase("leave them out, or take them again")
    match kind:
        case "blank":
            return phrases("{n} photo shows nothing: {names}", "{n} photos show nothing: {names}", n, names=who), again
        case "soft":
            return phrases("{n} photo is blurred: {names}", "{n} photos are blurred: {names}", n, names=who), again
        case "clipped":
            text = phrases("{n} photo is overexposed: {names}", "{n} photos are overexposed: {names}", n, names=who)
            return text, again
    text = phrases(
        "{n} photo is exposed unlike similar views: {names}",
        "{n} photos are exposed unlike similar views: {names}",
        n,
        names=who,
    )
    return text, phrase("leave them out, or even out the brightness")


def _limits_of_looks(facts: Facts, odd: dict[str, tuple[int, ...]]) -> list[Finding]:
    found, photos = [], facts.photos
    for kind in ("blank", "soft", "exposure", "clipped"):
        if kind in odd:
            text, advice = _of_looks(kind, len(odd[kind]), names(facts, odd[kind]))
            found.append(Finding(kind, LOOKS * len(odd[kind]) / len(photos), text, advice, odd[kind]))
    steps = np.abs([p.relative_exposure for p in photos if np.isfinite(p.relative_exposure)])
    if len(steps) > 2 and np.median(steps) > DRIFT:
        text = phrase(
            "the exposure changes from photo to photo, typically by {stops:.1f} stops: a model explains that with haze",
            stops=float(np.median(steps)),
        )
        found.append(Finding("drift", LOOKS * 0.5, text, phrase("lock the exposure")))
    return found + _limits_of_pixels(facts)


def _limits_of_pixels(facts: Facts) -> list[Finding]:
    found, photos = [], facts.photos
    sharp = np.array([p.sharpness for p in photos])
    longest = float(np.median([max(p.size) for p in photos]))
    if np.isfinite(sharp).any() and np.nanmedian(sharp) < SOFT_ALL and longest >= 2 * SMALL:
        text = phrase(
            "photos are soft at {pixels:,.0f} pixels (sharpness {sharpness:.2f}): half that size shows nearly the same",
            pixels=longest,
            sharpness=float(np.nanmedian(sharp)),
        )
        found.append(Finding("soft all", LOOKS * 0.3, text, phrase("load them at half size: training is faster")))
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
        advice = phrase("calibrate again, unless the lens was zoomed or the camera another")
        found.append(Finding("focal", LOOKS * len(focal) / len(facts.photos), text, advice, focal))
    return found
