"""Open a pixel completely: its ray, its verdict, the radiance and the evidence of its point, and its stages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Method, Radiant, aimed
from nerf_core.probe.directions import Around
from nerf_core.probe.evidence import Exposures, TrainingViews
from nerf_core.probe.layers import grain_at, layers_of
from nerf_core.probe.radiance import LayerRadiance, default_t, layer_at, open_radiance
from nerf_core.probe.ray import FARTHEST, open_ray
from nerf_core.probe.records import Opened
from nerf_core.probe.standing import Verdict
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
    exposures: Exposures | None = None,
) -> Opened:
    """Open a pixel completely. `open_ray`, `judge`, `open_radiance` and `walk` give the parts one by one.

    Args:
        method: the model. Verdict and evidence need samples along a ray (`Traceable`), radiance needs `Radiant` too,
            normals need `Dense`, and the method's own stages need `Explainable`; without them these parts are left out.
        scene: the scene; its training photos give the evidence.
        camera: any camera, not only one of the scene's.
        pixel: integer column and row in the camera's picture.
        step: the training step of the model. It is copied into the result and is not used otherwise.
        point_t: world distance along the ray of the point whose radiance and evidence are wanted. None takes the
            layer of the verdict's surface, in the middle of its weight, else the default of `open_radiance`.
        around: what the radiance's disc has at its centre: "viewer" for the direction to the camera, or "normal" for
            the density's normal.
        exposures: those of `Trainer.exposures`; None: photos are taken as they are.

    Returns:
        The opened pixel. `name` and `history` stay empty, because only pins have them.

    Raises:
        UserError: the pixel lies outside the picture, or `point_t` is no distance on the ray.
    """
    opened = None
    for opened in pieces(method, TrainingViews(scene, exposures), camera, pixel, step, point_t, around):  # noqa: B007  the last piece is complete
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
    method = aimed(method, camera)
    opened = Opened(camera, scene, METHODS.name_of(type(method)), open_ray(method, scene, camera, pixel, step))
    if not opened.ray.passes:  # nothing to judge: no weight says where a surface is
        yield opened
        yield replace(opened, walk=walk(method, scene, camera, opened.ray))
        return
    if point_t is not None:
        if point_t > FARTHEST * opened.ray.far:
            fit = f"give a distance from {opened.ray.near:.4g} to {opened.ray.far:.4g}"
            raise UserError(f"t {point_t:g}: the point lies far behind all that the ray meets: {fit}")
        opened = _with_point(method, training_views, opened, point_t, around, asked=True)
    yield opened
    for verdict in judging(method, training_views, opened.ray):
        opened = replace(opened, verdict=verdict)
        yield opened
    if point_t is None:
        assert opened.verdict is not None
        opened = _with_point(method, training_views, opened, _best_t(opened, opened.verdict), around, asked=False)
        yield opened
    yield replace(opened, walk=walk(method, scene, camera, opened.ray))


def _best_t(opened: Opened, verdict: Verdict) -> float:
    """Return the distance of the point that is shown first.

    It is the middle of the weight of the layer that is the surface. The surface itself lies in front of it, where on a
    highlight the colour can be another. A surface that something hides has no weight on this ray: it is shown itself.
    """
    layers = layers_of(opened.ray, opened.scene)
    if verdict.surface_t is None:
        return default_t(opened.ray, layers)
    layer = layer_at(layers, verdict.surface_t)
    return verdict.surface_t if layer is None else layer.t


def _with_point(
    method: Method, training_views: TrainingViews, opened: Opened, t: float, around: Around, asked: bool
) -> Opened:
    """Add the evidence of the point at t, and the radiance there if the method has one. asked: the user chose t."""
    scene, ray, look = training_views.scene, opened.ray, opened.ray.direction.astype(np.float64)
    layer = layer_at(layers_of(ray, scene), t)
    point = ray.origin.astype(np.float64) + t * look
    margin = grain_at(float(t), scene.radius) if asked or layer is None else layer.margin
    evidence = training_views.look(method, point, look, margin)
    radiance = None
    if isinstance(method, Radiant):
        radiance = open_radiance(method, scene, ray, opened.camera.c2w[:, 1], t, around)
    if isinstance(method, Radiant) and layer is not None:
        looking = torch.from_numpy(-evidence.directions)
        emitted = LayerRadiance(method, scene, ray, layer).radiance(torch.from_numpy(point)[None], looking)[0].numpy()
        evidence = replace(evidence, layer_emitted=emitted)
    if radiance is not None and radiance.layer is not None and not asked:
        radiance = replace(radiance, default="layer")
    return replace(opened, radiance=radiance, evidence=evidence)
