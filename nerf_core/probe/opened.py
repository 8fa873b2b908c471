"""Open a pixel completely: its ray, its verdict, the radiance and the evidence of its point, and its stages."""

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
    """Open a pixel completely. `open_ray`, `judge`, `open_radiance` and `walk` give the parts one by one.

    Args:
        method: the model. It must keep samples along a ray (`Traceable`). Radiance needs `Radiant`, normals need
            `Dense`, and the method's own stages need `Explainable`; without them these parts are left out.
        scene: the scene; its training photos give the evidence.
        camera: any camera, not only one of the scene's.
        pixel: integer column and row in the camera's picture.
        step: the training step of the model. It is copied into the result and is not used otherwise.
        point_t: world distance along the ray of the point whose radiance and evidence are wanted. None takes the
            verdict's surface, else the default of `open_radiance`.
        around: what the radiance's disc has at its centre: "viewer" for the direction to the camera, or "normal" for
            the density's normal.

    Returns:
        The opened pixel. `name` and `history` stay empty, because only pins have them.

    Raises:
        UserError: the pixel lies outside the picture, `point_t` is no distance on the ray, or the method keeps no
            samples.
    """
    opened = None
    for opened in pieces(method, TrainingViews(scene), camera, pixel, step, point_t, around):  # noqa: B007  the last piece is complete
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
    """Open a pixel in pieces, so that the caller can do other work in between.

    Arguments and errors are those of `open_pixel`. `training_views` takes the place of the scene, because it can be
    made once for many pixels. Each piece contains the earlier ones and more. If `point_t` is given, its radiance is in
    the first piece: while the user drags the point, it is asked for again before the verdict is ready.
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
    """Add the evidence of the point at t, and its radiance if the method has one."""
    radius, look = training_views.scene.radius, opened.ray.direction.astype(np.float64)
    radiance = None
    if isinstance(method, Radiant):
        radiance = open_radiance(method, training_views.scene, opened.ray, opened.camera.c2w[:, 1], t, around)
    t = opened.ray.point_t() if t is None else t
    point = opened.ray.origin.astype(np.float64) + t * look
    evidence = training_views.look(method, point, look, grain_at(float(t), radius))
    return replace(opened, radiance=radiance, evidence=evidence)
