"""One ray, opened up as plain arrays: what made a pixel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method, traced
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.rendering.images import tile_rays

FARTHEST = 3.0  # times the scene's far bound: where space has no end, fog reaches to a horizon that no plot can show
MOST_RAYS = 512  # traced together: every ray takes the room of the longest one


def sample_ends(scene: Scene, rays: Rays, samples: Samples) -> Tensor:
    """The world distances (R, S) float64 up to which samples stand for their rays: t + δ."""
    t, delta = samples.t.double().cpu(), samples.delta.double().cpu()
    if scene.ndc is None:
        return t + delta
    return torch.maximum(t, scene.ndc.stretched(rays.origins.double(), rays.directions.double(), t, delta))


def passes_of(scene: Scene, rays: Rays, trace: Trace, i: int) -> tuple[PassProbe, ...]:
    """What was composited along ray i of `rays`."""
    return tuple(
        PassProbe(s.name, *(v[i, : s.t.shape[1] if s.count is None else int(s.count[i])].cpu().numpy() for v in (
            s.t, sample_ends(scene, rays, s), s.delta, s.sigma, s.alpha, s.transmittance, s.weights, s.rgb)))
        for s in trace.passes
    )  # fmt: skip


def _matters_until(p: PassProbe) -> float:
    """The distance up to which a pass has all but a thousandth of its weight: in open space samples go on for ever."""
    total = np.cumsum(p.weights, dtype=np.float64)
    if not len(total) or total[-1] == 0:
        return -np.inf
    return float(p.t[np.searchsorted(total, 0.999 * total[-1])])


def open_ray(method: Method, scene: Scene, camera: Camera, pixel: tuple[int, int], step: int) -> RayProbe:
    """Everything that made integer `pixel` (column, row) of `camera`. Raises UserError outside the picture,
    and if the method keeps no samples.

    The pixel runs through the same code as in the full-resolution picture, where that matters with a tile's share of
    its neighbours, so the composited colour is the rendered one. A median is the first sample at which the accumulated
    weight reaches 0.5.
    """
    column, row = pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        fit = f"columns 0 … {camera.width - 1}, rows 0 … {camera.height - 1}"
        raise UserError(f"pixel {column} {row}: outside the picture, {fit}")
    flat = row * camera.width + column
    count = 1 if method.alone else min(method.tile, MOST_RAYS)
    rays, i = tile_rays(camera, scene, flat - flat % count, count), flat % count
    trace, rendered = traced(method, rays), method.render(rays)
    passes = passes_of(scene, rays, trace, i)
    last = passes[-1]
    opacity = min(float(last.weights.sum(dtype=np.float64)), 1.0)  # rounding may carry it a little over
    background = np.array(scene.background, dtype=np.float32)
    color = last.weights.astype(np.float64) @ last.rgb + (1 - opacity) * background
    depth = float(trace.rendering.depth[i])
    half = int(np.searchsorted(np.cumsum(last.weights, dtype=np.float64), 0.5))
    return RayProbe(
        step=step,
        pixel=pixel,
        origin=rays.origins[i].numpy(),
        direction=rays.directions[i].numpy(),
        # under NDC samples lie between the near plane and the far bound, which the capture's bounds need not reach
        near=min([float(rays.near[i]), *(float(p.t[0]) for p in passes if len(p.t))]),
        far=max([float(rays.far[i]), *(min(_matters_until(p), FARTHEST * float(rays.far[i])) for p in passes)]),
        passes=passes,
        color=color.astype(np.float32),
        opacity=opacity,
        depth_expected=depth if np.isfinite(depth) else None,
        depth_median=float(last.t[half]) if half < len(last.t) else None,
        depth_strongest=float(last.t[int(np.argmax(last.weights))]) if opacity > 0 else None,
        rendered_color=rendered.color[i].cpu().numpy(),
        background=background,
    )
