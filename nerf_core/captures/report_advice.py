"""A capture in words: what it is good for, how its cameras stand and are calibrated, what to photograph next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerf_core.captures.report_odd import Facts, names
from nerf_core.captures.report_records import Finding, Gap, PhotoFacts
from nerf_core.captures.report_views import coverage, directions, layout
from nerf_core.common.language import digits, phrase, phrases
from nerf_core.common.text import number
from nerf_core.datasets.calibration import oddities
from nerf_core.datasets.rig import common_focus

FEW = 20  # the least that a scene of LLFF's captures has
WIDE_STEP = 20.0  # degrees between neighbours: guides to photogrammetry ask for 10° to 15°
STEP = 12.0  # degrees between photos that are advised: 30 for a ring
# A fault of single photos makes a capture unfit if this share of the training photos has one: neighbours fill in for
# one photo in ten, but not for one in four.
SPOILT = 0.25
SPOILS = ("blank", "soft", "clipped", "pose")
# Limits of the whole make it unfit from this score: a gap of 144° at one height, half of FEW photos, steps of 45°, half
# of the photos alone, a calibration that cannot be right. Other limits never do.
SERIOUS = 1.0
OF_THE_WHOLE = ("gap", "few", "steps", "alone", "calibration")
PRINCIPAL = 0.05  # image sizes from the centre: phones have 0.01, cropped photos more


def overall(facts: Facts, found: Sequence[Finding]) -> str:
    """Say what a capture is good for, what limits it most, and what to do next.

    Args:
        facts: what is known of the capture.
        found: what limits the quality, the worst first.

    Returns:
        Two or three short sentences, a phrase.
    """
    use = _use(facts, found)
    if not found:
        return phrase("This capture is good for {use}; no limit was found. Next: train it.", use=use)
    spoils = _spoils(facts, found)
    if spoils is not None:
        return phrase(
            "This capture is not yet good for {use}. What limits it most: {limit}. Next: {advice}.",
            use=use, limit=spoils.text, advice=spoils.advice,
        )  # fmt: skip
    worst = found[0]
    return phrase(
        "This capture is good for {use}. What limits it most: {limit}. Next: {advice}.",
        use=use, limit=worst.text, advice=worst.advice,
    )  # fmt: skip


def _spoils(facts: Facts, found: Sequence[Finding]) -> Finding | None:
    """The worst limit that makes a capture unfit, alone or together with other faults of single photos; or None."""
    of_photos = [one for one in found if one.kind in SPOILS]
    for one in found:
        if one.kind in OF_THE_WHOLE and one.score >= SERIOUS:
            return one
        if one.kind in SPOILS and _share(facts, [one]) >= SPOILT:
            return one
    return of_photos[0] if _share(facts, of_photos) >= SPOILT else None


def _share(facts: Facts, found: Sequence[Finding]) -> float:
    """The share of the training photos that some findings are about."""
    return float(np.isin(facts.train, _photos(found)).mean())


def _photos(found: Sequence[Finding]) -> list[int]:
    return [k for one in found for k in one.photos]


def _use(facts: Facts, found: Sequence[Finding]) -> str:
    """Which views the cameras allow, as they stand. Photos that show nothing, and wrong poses, do not count."""
    void = _photos([one for one in found if one.kind in ("blank", "pose")])
    train = facts.train[~np.isin(facts.train, void)]
    if not len(train):
        return phrase("new views")
    scene = facts.scene
    focus = common_focus(scene.poses[train]) if len(train) < len(facts.train) else None
    where = layout(scene if focus is None else replace(scene, center=focus), train)
    match where.kind:
        case "around":
            gaps = coverage(where, train).gaps
            return phrase("views from most sides") if gaps else phrase("views from all sides")
        case "one-sided":
            return phrase("views from the side that was photographed")
        case "forward-facing":
            return phrase("small camera movements in front of what was photographed")
        case "free":
            return phrase("views from near where the photos were taken")
    return phrase("new views")


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
            "front is the middle of that side, where {front} was taken.",
            count=count, front=front, **angles,
        )  # fmt: skip
    if where.kind == "forward-facing":
        wide, high = _window(facts)
        return phrase(
            "{count} that look one way, from a window of {wide} × {high} units. Views from beside or behind cannot be "
            "shown, so gaps around the centre are not looked for.",
            count=count, wide=number(wide, 2), high=number(high, 2),
        )  # fmt: skip
    if where.kind == "single":
        return phrase("One training photo: depth cannot be learnt from it.")
    return phrase(
        "{count} that look in many directions, as in a room. Gaps around a centre are not looked for.",
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
        text = phrase("Add photos in between, at most {step:.0f}° apart.", step=STEP)
        said.append(text)
    if where.kind == "one-sided":
        least = math.ceil((360 - where.around) / (1.5 * STEP))
        text = phrase(
            "To show it from all sides, walk on around it: add {least} to {most} photos from the right, past the back, "
            "to the left, at an elevation of about {height}.",
            least=least, most=math.ceil(1.5 * least), height=whole(np.median(where.elevation[facts.train])),
        )  # fmt: skip
        said.append(text)
    if where.kind == "forward-facing":
        wide, high = _window(facts)
        text = phrase(
            "To move the camera farther, add photos from up to {wide} units further left and right, and {high} further "
            "up and down.",
            wide=number(wide / 2, 2), high=number(high / 2, 2),
        )  # fmt: skip
        said.append(text)
    if facts.inward and where.elevation[facts.train].max() < 45:
        text = phrase(
            "To look down from above as well, add {least} to {most} photos at elevations of 50° to 60°.",
            least=6,
            most=10,
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
