"""Open a ray: the samples that make a pixel, as plain arrays."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.view_rays import beginning
from nerf_core.methods import Method, Traceable, Visiting, aimed
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.rendering.images import tile_rays

# An opened ray reaches to at most this many times the scene's far bound. In unbounded space, fog can reach so far that
# no plot can show it.
FARTHEST = 3.0
MOST_RAYS = 512  # rays traced together: every ray takes as much memory as the one with the most samples


def sample_ends(scene: Scene, rays: Rays, samples: Samples) -> Tensor:
    """Return where the samples' stretches end, as world distances (R, S) float64: t + δ.

    Under NDC it is the world distance of t′ + δ.

    Args:
        scene: the scene.
        rays: R rays.
        samples: their samples.
    """
    t, delta = samples.t.double().cpu(), samples.delta.double().cpu()
    if scene.ndc is None:
        return t + delta
    return torch.maximum(t, scene.ndc.stretched(rays.origins.double(), rays.directions.double(), t, delta))


def passes_of(scene: Scene, rays: Rays, trace: Trace, i: int) -> tuple[PassProbe, ...]:
    """Return the passes of ray i of `rays` as plain arrays, coarse before fine, without padding.

    Args:
        scene: the scene.
        rays: R rays.
        trace: what the method composited along them.
        i: the index of the ray.
    """
    return tuple(
        PassProbe(s.name, *(v[i, : s.t.shape[1] if s.count is None else int(s.count[i])].cpu().numpy() for v in (
            s.t, sample_ends(scene, rays, s), s.delta, s.sigma, s.alpha, s.transmittance, s.weights, s.rgb)))
        for s in trace.passes
    )  # fmt: skip


def _matters_until(p: PassProbe) -> float:
    """Return the distance up to which a pass has all but a thousandth of its weight; −inf if it has none.

    The last sample itself is no bound, because in unbounded space the samples go on to the horizon.
    """
    total = np.cumsum(p.weights, dtype=np.float64)
    if not len(total) or total[-1] == 0:
        return -np.inf
    return float(p.t[np.searchsorted(total, 0.999 * total[-1])])


def open_ray(method: Method, scene: Scene, camera: Camera, pixel: tuple[int, int], step: int) -> RayProbe:
    """Open the ray of a pixel: all samples that make it, and its colour and depths.

    A method that keeps no samples gives a ray without passes, with the places that it visited if it tells them.

    The pixel is computed by the renderer's own code. If the method rounds differently for other batch sizes (`alone` is
    False), it is computed together with its tile's neighbours. So the composited colour is the rendered one.

    Args:
        method: the model.
        scene: its scene.
        camera: any camera.
        pixel: integer column and row in the camera's picture.
        step: the training step of the model. It is copied into the result and is not used otherwise.

    Returns:
        The ray with the samples of all its passes.

    Raises:
        UserError: the pixel lies outside the picture.
    """
    column, row = pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        fit = f"columns 0 … {camera.width - 1}, rows 0 … {camera.height - 1}"
        raise UserError(f"pixel {column} {row}: outside the picture, {fit}")
    flat = row * camera.width + column
    count = 1 if method.alone else min(method.tile, MOST_RAYS)
    rays, i = tile_rays(camera, scene, flat - flat % count, count), flat % count
    method = aimed(method, camera)
    rendered = method.render(rays)
    background = np.array(scene.background, dtype=np.float32)
    common = {
        "step": step,
        "pixel": pixel,
        "origin": rays.origins[i].numpy(),
        "direction": rays.directions[i].numpy(),
        "rendered_color": rendered.color[i].cpu().numpy(),
        "background": background,
        "begins": beginning(scene, camera, float(rays.near[i])),
    }
    if not isinstance(method, Traceable):
        depth, places = float(rendered.depth[i]), np.zeros(0, np.float32)
        if isinstance(method, Visiting):
            places = method.visited(rays)[i].float().cpu().numpy()
        met = [*places.tolist(), *([depth] if np.isfinite(depth) else [])]
        return RayProbe(
            **common,
            near=min([float(rays.near[i]), *met]),
            far=min(max([float(rays.far[i]), *met]), FARTHEST * float(rays.far[i])),
            passes=(),
            color=common["rendered_color"],
            opacity=float(rendered.opacity[i]),
            depth_expected=depth if np.isfinite(depth) else None,
            depth_median=None,
            depth_strongest=None,
            visited=places,
        )
    trace = method.trace(rays)
    passes = passes_of(scene, rays, trace, i)
    last = passes[-1]
    opacity = min(float(last.weights.sum(dtype=np.float64)), 1.0)  # rounding may exceed 1 slightly
    color = last.weights.astype(np.float64) @ last.rgb + (1 - opacity) * background
    depth = float(trace.rendering.depth[i])
    half = int(np.searchsorted(np.cumsum(last.weights, dtype=np.float64), 0.5))
    return RayProbe(
        **common,
        # under NDC, samples may lie outside the capture's bounds: they fill near plane to far bound
        near=min([float(rays.near[i]), *(float(p.t[0]) for p in passes if len(p.t))]),
        far=max([float(rays.far[i]), *(min(_matters_until(p), FARTHEST * float(rays.far[i])) for p in passes)]),
        passes=passes,
        color=color.astype(np.float32),
        opacity=opacity,
        depth_expected=depth if np.isfinite(depth) else None,
        depth_median=float(last.t[half]) if half < len(last.t) else None,
        depth_strongest=float(last.t[int(np.argmax(last.weights))]) if opacity > 0 else None,
    )
