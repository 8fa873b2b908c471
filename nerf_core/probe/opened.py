"""A pixel opened whole: its ray, the verdict on it, its point's radiance and evidence, and its walk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Method, Radiant
from nerf_core.probe.directions import Around
from nerf_core.probe.evidence import TrainingViews
from nerf_core.probe.layers import grain_at
from nerf_core.probe.radiance import open_radiance
from nerf_core.probe.ray import FARTHEST, open_ray
from nerf_core.probe.records import Opened
from nerf_core.probe.verdict import judging
from nerf_core.probe.walkthrough import walk


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
    for opened in pieces(method, TrainingViews(scene), camera, pixel, step, point_t, around):  # noqa: B007  the last counts
        pass
    assert opened is not None
    return opened


def pieces(
    method: Method,
    training_views: TrainingViews,
    camera: Camera,
    pixel: tuple[int, int],
    step: int,
    point_t: float | None,
    around: Around,
) -> Iterator[Opened]:
    """`open_pixel` in pieces, each with more of it, for whoever has something else to do in between.

    A point that is asked for comes in the first of them: a hand that drags it asks anew before the verdict is there.
    """
    if point_t is not None and not 0 <= point_t < np.inf:
        raise UserError(f"t {point_t}: the point's distance along the ray must be a number of at least 0")
    scene = training_views.scene
    opened = Opened(camera, scene, METHODS.name_of(type(method)), open_ray(method, scene, camera, pixel, step))
    if point_t is not None:
        if point_t > FARTHEST * opened.ray.far:
            fit = f"give a distance from {opened.ray.near:.4g} to {opened.ray.far:.4g}"
            raise UserError(f"t {point_t:g}: the point lies far behind all that the ray meets: {fit}")
        opened = _with_point(method, training_views, opened, point_t, around)
    yield opened
    for verdict in judging(method, training_views, opened.ray):
        opened = replace(opened, verdict=verdict)
        yield opened
    if point_t is None:
        assert opened.verdict is not None
        opened = _with_point(method, training_views, opened, opened.verdict.surface_t, around)
        yield opened
    yield replace(opened, walk=walk(method, scene, camera, opened.ray))


def _with_point(
    method: Method, training_views: TrainingViews, opened: Opened, t: float | None, around: Around
) -> Opened:
    """With the radiance of the point at t, if the method has one, and what the photos know of the point."""
    radius, look = training_views.scene.radius, opened.ray.direction.astype(np.float64)
    radiance = None
    if isinstance(method, Radiant):
        radiance = open_radiance(method, training_views.scene, opened.ray, opened.camera.c2w[:, 1], t, around)
    t = opened.ray.point_t() if t is None else t
    point = opened.ray.origin.astype(np.float64) + t * look
    evidence = training_views.look(method, point, look, grain_at(float(t), radius))
    return replace(opened, radiance=radiance, evidence=evidence)
