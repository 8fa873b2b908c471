"""Reach the verdict on a pixel: find its layers, ask the training photos about each, and conclude.

The photos that see a layer decide more than its shape does. Would the model match a photo better without the layer?
Then the photo contradicts it. Would the model match it worse? Then the photo would miss it. If enough photos contradict
a layer and no more would miss it, it is a floater. Would the photos be matched better if no background showed from the
layer on? Then the background leaks through it. docs/microscope.md states all the rules.
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
from nerf_core.probe.standing import FEW, Layer, Standing, Verdict
from nerf_core.probe.verdicts import COUNTS, NOTHING, VERDICTS, Facts, outer, tolerance

ASIDE = np.radians(75)  # a photo at a larger angle to the ray does not see this side of a layer
ASKED = 16  # of the photos that see a layer, so many are asked: those nearest in angle
REACHES = np.array([1.0, 3.0, 8.0, 20.0])  # grains: a layer may hide how far it extends, so several ends are tried
# The photos are asked about the MOST_LAYERS heaviest layers. The search for a surface behind floaters tries at most
# MOST_HIDDEN layers.
MOST_LAYERS, MOST_HIDDEN = 4, 8


def judge(method: Method, training_views: TrainingViews, ray: RayProbe) -> Verdict:
    """Reach the verdict on a pixel.

    Args:
        method: the model; it must keep samples along a ray.
        training_views: the photos of its scene.
        ray: the opened ray of the pixel.

    Returns:
        The verdict with its reasons, and the layers with what the photos say about them.

    Raises:
        UserError: the method keeps no samples.
    """
    *_, verdict = judging(method, training_views, ray)
    assert verdict is not None
    return verdict


def judging(method: Method, training_views: TrainingViews, ray: RayProbe) -> Iterator[Verdict | None]:
    """Reach the verdict in pieces, as `judge` does. Yields None after each layer, and the verdict at last."""
    found = layers_of(ray, training_views.scene)
    standings = []
    for layer in sorted(sorted(found, key=lambda one: -one.weight)[:MOST_LAYERS], key=lambda one: one.t):
        standings.append(stand(method, training_views, ray, layer))
        yield None
    verdict = conclude(ray, tuple(standings))
    if any(s.floats and s.layer.weight >= COUNTS for s in standings):
        last = max(s.layer.t for s in standings if s.floats and s.layer.weight >= COUNTS)
        # a layer that hardly a photo sees may be the floater's inside
        behind = [s.layer for s in outer(standings) if s.layer.t > last and s.training_views >= FEW]
        rest = max(behind, key=lambda layer: layer.weight, default=None)
        t = rest.surface if rest is not None else _hidden_surface(method, training_views, ray, verdict.standings)
        verdict = replace(verdict, surface_t=t)
    yield verdict


def stand(method: Method, training_views: TrainingViews, ray: RayProbe, layer: Layer) -> Standing:
    """Ask the photos about a layer.

    Args:
        method: the model; it must keep samples along a ray.
        training_views: the photos of its scene.
        ray: the opened ray that has the layer.
        layer: one of `layers_of(ray, scene)`.

    Returns:
        The photos' answers; all counts of voters are 0 if no photo sees the layer.
    """
    point = ray.origin.astype(np.float64) + layer.t * ray.direction.astype(np.float64)
    margin = layer.margin
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
    return max(found, key=lambda one: (one.floats, one.against, -one.missing))  # the first of equals


def _hidden_surface(
    method: Method, training_views: TrainingViews, ray: RayProbe, standings: tuple[Standing, ...]
) -> float | None:
    """Search for the surface behind floaters that hide it, with rays that begin behind them.

    Returns the world distance of the first layer that enough photos see and that does not float; None if there is none.
    """
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
        begin = heavy[0].end  # not its reach, which may span a whole floater: some photos see it from behind
    return None


def conclude(ray: RayProbe, standings: tuple[Standing, ...]) -> Verdict:
    """Choose the verdict from what is known, without asking the photos again.

    Args:
        ray: the opened ray.
        standings: its layers from front to back, with what the photos say about each.

    Returns:
        The verdict of the first class, by ascending rank, that gives reasons.
    """
    facts = Facts(ray, standings)
    classes = [(name, VERDICTS.get(name)) for name in VERDICTS.names()]
    for name, one in sorted(classes, key=lambda item: item[1].rank):
        reasons = one.reasons(facts)
        if reasons:
            rest = facts.surface if ray.opacity >= NOTHING else None
            return Verdict(name, reasons, None if rest is None else rest.layer.surface, standings, one.tone)
    raise AssertionError("the class of the last rank always holds")


def _off(colors: np.ndarray, photos: np.ndarray) -> np.ndarray:
    """Return the error of each photo, (V,): |colors − photos| (V, 3) averaged over the channels."""
    return np.abs(colors - photos).mean(-1)
