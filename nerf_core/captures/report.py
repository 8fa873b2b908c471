"""Check the photos and poses of a capture before anything is trained."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nerf_core.captures.report_advice import advise, calibration, overall, summary
from nerf_core.captures.report_limits import limits
from nerf_core.captures.report_odd import Facts, odd_ones
from nerf_core.captures.report_records import CaptureReport, PhotoFacts
from nerf_core.captures.report_views import Layout, Near, coverage, layout, neighbours
from nerf_core.captures.sharpness import Measure, measure_photo, thumbnail
from nerf_core.common.language import marked, phrase
from nerf_core.datasets.capture import LoadOptions
from nerf_core.datasets.loading import load_scene
from nerf_core.geometry.scene import Scene

Progress = Callable[[str, int, int], None]
MOST_THUMBNAILS = 400  # of 5 kB each: a page of 2.7 MB in base64; of more photos only some, and the odd ones, have one
WHITE = (1.0, 1.0, 1.0)


class ReportCancelled(Exception):
    """`cancel` asked for the end of the check."""


@dataclass(frozen=True)
class ReportOptions:
    """How a capture is checked.

    load: how it is loaded, if it is not yet.
    thumbnails: whether the report has small pictures.
    """

    load: LoadOptions = field(default_factory=LoadOptions)
    thumbnails: bool = True


def capture_report(
    source: Scene | Path | None,
    options: ReportOptions | None = None,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
) -> CaptureReport:
    """Check a capture.

    Args:
        source: a scene, or the path of a capture; None: the demo scene.
        options: how.
        progress: called as (what is done, photos done, photos in all).
        cancel: asked every few milliseconds whether to stop.

    Returns:
        The report. `report_html.to_html` and `report_json.to_json` write it.

    Raises:
        UserError: the capture cannot be loaded.
        ReportCancelled: `cancel` returned True.
    """
    options = options or ReportOptions()
    scene = source if isinstance(source, Scene) else load_scene(source, options.load, progress)
    work = checking(scene, options.thumbnails)
    while True:
        try:
            done, total = next(work)
        except StopIteration as end:
            return end.value
        if cancel is not None and cancel():
            raise ReportCancelled
        if progress is not None:
            progress(phrase("measuring photos"), done, total)


def checking(scene: Scene, thumbnails: bool = True) -> Generator[tuple[int, int], None, CaptureReport]:
    """Check a scene in pieces of a few milliseconds, each of which yields (photos done, photos in all)."""
    count = len(scene.views)
    train = np.array(scene.split("train") or range(count))
    where = layout(scene, train)
    depth = _depths(scene, where)
    work, near = neighbours(where, depth, train), None
    while near is None:
        try:
            next(work)
            yield 0, count
        except StopIteration as end:
            near = end.value
    # a picture on white has a plain background, whose brightness says nothing of the exposure
    ground = scene.background if scene.synthetic or scene.background == WHITE else None
    measures: list[Measure] = []
    for k in range(count):
        piece = measure_photo(scene.photos, k, ground)
        while True:
            try:
                next(piece)
                yield k, count
            except StopIteration as end:
                measures.append(end.value)
                break
    photos = _photos(scene, where, near, measures)
    facts = Facts(scene, photos, where, near, train, coverage(where, train), depth)
    photos, odd = odd_ones(facts)
    yield count, count
    if thumbnails:
        chosen = set(np.linspace(0, count - 1, min(count, MOST_THUMBNAILS)).round().astype(int).tolist())
        pictures = list(photos)
        for k, one in enumerate(photos):
            if k in chosen or one.odd:
                pictures[k] = replace(one, thumbnail=thumbnail(scene.photos, k))
                yield count, count
        photos = tuple(pictures)
    return _report(replace(facts, photos=photos), odd)


def _report(facts: Facts, odd: dict[str, tuple[int, ...]]) -> CaptureReport:
    scene, where, covered = facts.scene, facts.where, facts.covered
    points = np.zeros((0, 3))
    if scene.points is not None:
        points = (scene.points - where.center) @ where.axes.T
    free, found = where.kind == "free", limits(facts, odd)
    return CaptureReport(
        name=scene.name,
        format=scene.format,
        kind=where.kind,
        overall=overall(facts, found),
        summary=summary(facts),
        photos=facts.photos,
        front=where.front,
        center=where.center,
        axes=where.axes,
        center_name=marked("the middle of the cameras") if free else marked("the centre that the cameras look at"),
        points=points.astype(np.float32),
        azimuths=covered.azimuths,
        heights=covered.heights,
        uncovered=covered.uncovered,
        gaps=covered.gaps,
        limits=found,
        next=advise(facts),
        calibration=calibration(facts),
        notes=scene.notes,
        units_to_input=float(np.cbrt(abs(np.linalg.det(scene.to_input[:3, :3])))),
    )


def _depths(scene: Scene, where: Layout) -> np.ndarray:
    """How far what each camera shows is: the depth of the centre, within the scene's bounds."""
    along = (-where.positions * where.forwards).sum(1)
    if where.kind == "free":
        along = np.full(len(along), np.sqrt(scene.near * scene.far))  # nothing is known of a middle
    return np.clip(along, scene.near, scene.far)


def _photos(scene: Scene, where: Layout, near: Near, measures: list[Measure]) -> tuple[PhotoFacts, ...]:
    split = {i: name for name, indices in scene.splits.items() for i in indices}
    sharp = np.array([m.sharpness for m in measures])
    light = np.array([m.exposure for m in measures])
    usual_sharp, usual_light = _of_neighbours(sharp, near.similar), _of_neighbours(light, near.similar)
    return tuple(
        PhotoFacts(
            name=view.name,
            split=split.get(k, ""),
            view=k,
            size=(view.camera.width, view.camera.height),
            position=where.positions[k],
            forward=where.forwards[k],
            azimuth=float(where.azimuth[k]),
            elevation=float(where.elevation[k]),
            distance=float(where.distance[k]),
            off_centre=float(where.off_centre[k]),
            nearest=int(near.similar[k, 0]),
            separation=float(near.separation[k]),
            nearest_by_place=int(near.by_place[k]),
            place_distance=float(near.place_distance[k]),
            field_of_view=float(2 * np.degrees(np.arctan(view.camera.width / 2 / view.camera.fx))),
            sharpness=measures[k].sharpness,
            relative_sharpness=float(sharp[k] / max(usual_sharp[k], 1e-12)),
            exposure=measures[k].exposure,
            relative_exposure=float(light[k] - usual_light[k]),
            highlights=measures[k].highlights,
            shadows=measures[k].shadows,
        )
        for k, view in enumerate(scene.views)
    )


def _of_neighbours(values: np.ndarray, similar: np.ndarray) -> np.ndarray:
    """The median of the values of each photo's similar views; the photo's own where it has none."""
    picked = np.where(similar >= 0, values[similar], np.nan)
    picked[~np.isfinite(picked).any(1)] = values[~np.isfinite(picked).any(1), None]
    ordered = np.ma.median(np.ma.masked_invalid(picked), axis=1)
    return np.asarray(np.ma.filled(ordered, np.nan), np.float64)
