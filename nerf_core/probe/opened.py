"""A pixel opened whole: its ray, the verdict on it, its point's radiance and evidence, and its walk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from nerf_core.cameras import Camera
from nerf_core.errors import UserError
from nerf_core.methods import Method
from nerf_core.probe.evidence import Sightings, Witnesses
from nerf_core.probe.layers import grain_at
from nerf_core.probe.radiance import Around, RadianceProbe, open_radiance
from nerf_core.probe.ray import RayProbe, open_ray
from nerf_core.probe.verdict import Verdict, judging
from nerf_core.probe.walk import walk
from nerf_core.scene import Scene
from nerf_core.stations import Station


@dataclass(frozen=True)
class Opened:
    """Everything known of a pixel of `camera`; None, or empty: not yet. evidence is on the point of `radiance`."""

    camera: Camera
    ray: RayProbe
    verdict: Verdict | None = None
    radiance: RadianceProbe | None = None
    evidence: Sightings | None = None
    walk: tuple[Station, ...] = ()


def open_pixel(
    method: Method,
    scene: Scene,
    camera: Camera,
    pixel: tuple[int, int],
    step: int,
    point_t: float | None = None,
    around: Around = "viewer",
) -> Opened:
    """Integer `pixel` (column, row) of `camera`, opened whole; see `open_ray` and `open_radiance`.

    point_t: where on the ray the radiance is looked at; None: where the verdict has the surface, else as
    `open_radiance` chooses. Raises UserError outside the picture, and for a t that is no distance.
    """
    opened = None
    for opened in pieces(method, Witnesses(scene), camera, pixel, step, point_t, around):  # noqa: B007  the last counts
        pass
    assert opened is not None
    return opened


def pieces(
    method: Method,
    witnesses: Witnesses,
    camera: Camera,
    pixel: tuple[int, int],
    step: int,
    point_t: float | None,
    around: Around,
) -> Iterator[Opened]:
    """`open_pixel` in pieces, each with more of it, for whoever has something else to do in between."""
    if point_t is not None and not 0 <= point_t < np.inf:
        raise UserError(f"t {point_t}: the point's distance along the ray must be a number of at least 0")
    scene = witnesses.scene
    opened = Opened(camera, open_ray(method, scene, camera, pixel, step))
    yield opened
    for verdict in judging(method, witnesses, opened.ray):
        opened = replace(opened, verdict=verdict)
        yield opened
    assert opened.verdict is not None
    t = point_t if point_t is not None else opened.verdict.surface_t
    radiance = open_radiance(method, scene, opened.ray, camera.c2w[:, 1], t, around)
    look = opened.ray.direction.astype(np.float64)
    evidence = witnesses.look(method, radiance.point, look, grain_at(radiance.t, scene.radius))
    opened = replace(opened, radiance=radiance, evidence=evidence)
    yield opened
    yield replace(opened, walk=walk(method, scene, camera, opened.ray))
