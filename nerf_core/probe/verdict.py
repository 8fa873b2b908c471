"""What is wrong with a pixel, in words: its layers, what the photos say of each, and the conclusion.

Questions to the photos decide more than any threshold on shapes. How many of those that see a layer contradict it, as
they would be matched better if it were not there, or as well if there were nothing but background; and how many would
miss it? Where not few contradict it, and no more would miss it, it is a floater. Would the photos be matched better if
no background showed from there on? Then it leaks through.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from nerf_core.geometry.rays import Rays
from nerf_core.methods import Method, traced
from nerf_core.probe.evidence import TrainingViews
from nerf_core.probe.layers import layers_of, pass_layers
from nerf_core.probe.ray import passes_of
from nerf_core.probe.records import RayProbe
from nerf_core.probe.standing import FEW, THICK, Layer, Standing, Verdict
from nerf_core.probe.verdicts import COUNTS, NOTHING, VERDICTS, Facts, outer, tolerance

ASIDE = np.radians(75)  # between looks at a point: a photo that sees it from farther round does not see this side of it
ASKED = 16  # photos that see a layer, the nearest in angle: they are asked how they would look otherwise
REACHES = np.array([1.0, 3.0, 8.0, 20.0])  # grains behind a layer's end at which it may be over, where it hides that
MOST_LAYERS, MOST_HIDDEN = 4, 8


def judge(method: Method, training_views: TrainingViews, ray: RayProbe) -> Verdict:
    """Open the ray's layers, ask the photos, and conclude."""
    *_, verdict = judging(method, training_views, ray)
    assert verdict is not None
    return verdict


def judging(method: Method, training_views: TrainingViews, ray: RayProbe) -> Iterator[Verdict | None]:
    """`judge` in pieces, a layer at a time; the last is the verdict."""
    found = layers_of(ray, training_views.scene)
    standings = []
    for layer in sorted(sorted(found, key=lambda one: -one.weight)[:MOST_LAYERS], key=lambda one: one.t):
        standings.append(stand(method, training_views, ray, layer))
        yield None
    verdict = conclude(ray, tuple(standings))
    if any(s.floats and s.layer.weight >= COUNTS for s in standings):
        last = max(s.layer.t for s in standings if s.floats and s.layer.weight >= COUNTS)
        # what photos know nothing of may well be the floater's inside
        behind = [s.layer for s in outer(standings) if s.layer.t > last and s.training_views >= FEW]
        rest = max(behind, key=lambda layer: layer.weight, default=None)
        t = rest.surface if rest is not None else _hidden_surface(method, training_views, ray, verdict.standings)
        verdict = replace(verdict, surface_t=t)
    yield verdict


def stand(method: Method, training_views: TrainingViews, ray: RayProbe, layer: Layer) -> Standing:
    """What the photos say of a layer."""
    point = ray.origin.astype(np.float64) + layer.t * ray.direction.astype(np.float64)
    margin = layer.grain + min(layer.t - layer.begin, THICK * layer.grain)
    sightings = training_views.look(method, point, ray.direction.astype(np.float64), margin)
    counts = int((sightings.seen & (sightings.angle < ASIDE)).sum()), int(sightings.seen.sum())
    asked = sightings.at(np.flatnonzero(sightings.seen)[:ASKED])
    if not len(asked.views):
        return Standing(layer, sightings, *counts, 0, 0, 0, 0, 0, None, None, None, layer.end - layer.t)
    reaches = margin + REACHES * layer.grain
    without, opaque, bare = training_views.otherwise(method, asked, reaches)
    error, shown = _off(asked.predicted, asked.observed), asked.share >= COUNTS
    slack = tolerance(error)
    needless = (
        _off(bare, asked.observed) <= error + slack if training_views.scene.synthetic else np.zeros(len(error), bool)
    )

    def median(off: np.ndarray) -> float | None:
        return float(np.median(off[shown])) if shown.any() else None

    middle, opaquely, found = median(error), median(_off(opaque, asked.observed)), []
    for reach, instead in zip(reaches.tolist(), _off(without, asked.observed), strict=True):
        against = shown & ((instead < error - slack) | needless)
        missing = (instead > error + slack) & ~against
        blank = ~shown & ~missing
        found.append(Standing(
            layer, sightings, *counts, len(error), int(against.sum()), int(missing.sum()), int(blank.sum()),
            int(shown.sum()), middle, median(instead), opaquely, reach,
        ))  # fmt: skip
    return max(found, key=lambda one: (one.floats, one.against, -one.missing))  # of those alike the first


def _hidden_surface(
    method: Method, training_views: TrainingViews, ray: RayProbe, standings: tuple[Standing, ...]
) -> float | None:
    """Where the first layer lies that photos know and that does not float, behind what lets no light through."""
    scene = training_views.scene
    begin = max(s.layer.t + s.reach for s in standings if s.floats and s.layer.weight >= COUNTS)
    for _ in range(MOST_HIDDEN):
        o, d, near, far = (torch.as_tensor(v, dtype=torch.float32)[None] for v in (
            ray.origin, ray.direction, ray.near, ray.far))  # fmt: skip
        rays = training_views.beginning(Rays(o, d, near, far), torch.tensor([begin]))
        shift = float((rays.origins[0] - o[0]).norm())
        last = passes_of(scene, rays, traced(method, rays), 0)[-1]
        found = pass_layers(replace(last, t=last.t + shift, until=last.until + shift), ray.far, scene.radius)
        heavy = [layer for layer in found if layer.weight >= COUNTS]
        if not heavy:
            return None
        behind = stand(method, training_views, ray, heavy[0])
        if not behind.floats and behind.training_views >= FEW:
            return heavy[0].surface
        begin = heavy[0].end  # its reach would not do: for photos that see it from behind, that is the whole floater
    return None


def conclude(ray: RayProbe, standings: tuple[Standing, ...]) -> Verdict:
    """The verdict on what is known; no more is asked. The first class that holds, by rank, is taken."""
    facts = Facts(ray, standings)
    classes = [(name, VERDICTS.get(name)) for name in VERDICTS.names()]
    for name, one in sorted(classes, key=lambda item: item[1].rank):
        reasons = one.reasons(facts)
        if reasons:
            rest = facts.surface if ray.opacity >= NOTHING else None
            return Verdict(name, reasons, None if rest is None else rest.layer.surface, standings, one.tone)
    raise AssertionError("the class of the last rank always holds")


def _off(colors: np.ndarray, photos: np.ndarray) -> np.ndarray:
    """The mean difference of a channel in each photo, (V,)."""
    return np.abs(colors - photos).mean(-1)
