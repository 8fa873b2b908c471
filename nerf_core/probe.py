"""One ray, or one point and all its directions, opened up as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from nerf_core.cameras import Camera
from nerf_core.checkpoint import finite
from nerf_core.errors import UserError
from nerf_core.methods import Method
from nerf_core.render import tile_rays
from nerf_core.scene import Scene
from nerf_core.types import Rays, Samples

SPHERE_ROWS, SPHERE_COLUMNS = 32, 64  # 2,048 directions over the sphere
DISC_SIZE = 57  # about 2,500 more over the hemisphere that faces the viewer


@dataclass(frozen=True)
class PassProbe:
    """The samples of one pass along one ray, (S,) each, rgb (S, 3); see `nerf_core.types.Samples`.

    until: the distance at which the stretch ends that a sample stands for: t + δ, where δ is of the world.
    """

    name: str
    t: np.ndarray
    until: np.ndarray
    delta: np.ndarray
    sigma: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray
    weights: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class RayProbe:
    """What made one pixel, at training step `step`.

    pixel: integer (column, row) into the camera's image. passes: coarse before fine; the last one made the pixel.
    color: composited from the last pass, background included; rendered_color: the same pixel from the renderer.
    depth_expected: Σwt/Σw (under NDC that of t′, in the world), None where nothing was hit. depth_median: where
    accumulated weight passes 0.5, None where the opacity stays under 0.5. depth_strongest: the sample of largest
    weight, None where none has any. All are distances along the ray.
    near, far: the scene's bounds on this ray; beyond them as far as a pass has weight, but FARTHEST of its bound.
    """

    step: int
    pixel: tuple[int, int]
    origin: np.ndarray
    direction: np.ndarray
    near: float
    far: float
    passes: tuple[PassProbe, ...]
    color: np.ndarray
    opacity: float
    depth_expected: float | None
    depth_median: float | None
    depth_strongest: float | None
    rendered_color: np.ndarray
    background: np.ndarray

    def point_t(self) -> float:
        """Where the ray's point lies unless one is asked for."""
        for t in (self.depth_median, self.depth_strongest):
            if t is not None:
                return t
        return (self.near + self.far) / 2


@dataclass(frozen=True)
class RadianceProbe:
    """The colour that one point emits towards directions v (unit, from the point outwards): c(x, d = −v).

    directions, rgb: (K, 3); the first SPHERE_ROWS × SPHERE_COLUMNS cover the sphere row by row, from +up to −up,
    azimuth growing along a row; the rest are the disc's pixels inside the unit circle, row by row.
    axes: (3, 3) rows right, up, towards the viewer: what the disc is drawn in. up: the sphere map's pole; its
    azimuth 0 is `azimuth0`, growing towards cross(up, azimuth0).
    """

    step: int
    point: np.ndarray
    t: float
    directions: np.ndarray
    rgb: np.ndarray
    axes: np.ndarray
    up: np.ndarray
    azimuth0: np.ndarray

    def sphere_image(self) -> np.ndarray:
        """(SPHERE_ROWS, SPHERE_COLUMNS, 3) float32."""
        return self.rgb[: SPHERE_ROWS * SPHERE_COLUMNS].reshape(SPHERE_ROWS, SPHERE_COLUMNS, 3)

    def disc_image(self) -> np.ndarray:
        """(DISC_SIZE, DISC_SIZE, 4) float32, row 0 at the top, alpha 0 outside the circle."""
        inside = disc_grid()[2]
        image = np.zeros((DISC_SIZE, DISC_SIZE, 4), np.float32)
        image[inside, :3] = self.rgb[SPHERE_ROWS * SPHERE_COLUMNS :]
        image[inside, 3] = 1
        return image

    def sphere_position(self, direction: np.ndarray) -> tuple[float, float]:
        """Where a unit direction lies on the map: (column, row) in [0, 1), left to right and top to bottom."""
        side = np.cross(self.up, self.azimuth0)
        azimuth = np.arctan2(direction @ side, direction @ self.azimuth0) % (2 * np.pi)
        polar = np.arccos(np.clip(direction @ self.up, -1, 1))
        return float(azimuth / (2 * np.pi)), float(polar / np.pi)

    def disc_position(self, direction: np.ndarray) -> tuple[float, float] | None:
        """Where a unit direction lies on the disc, (x, y) in [−1, 1], y up; None on the far hemisphere."""
        x, y, z = self.axes @ direction
        return (float(x), float(y)) if z >= 0 else None


FARTHEST = 3.0  # times the scene's far bound: where space has no end, fog reaches to a horizon that no plot can show
MOST_RAYS = 512  # traced together: every ray takes the room of the longest one


def disc_grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y (y up) of the disc's pixel centres and which of them lie inside: three (DISC_SIZE, DISC_SIZE) arrays."""
    centres = (np.arange(DISC_SIZE) + 0.5) / DISC_SIZE * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    return x, y, x * x + y * y < 1


def _until(scene: Scene, rays: Rays, samples: Samples) -> Tensor:
    t, delta = samples.t.double().cpu(), samples.delta.double().cpu()
    if scene.ndc is None:
        return t + delta
    return torch.maximum(t, scene.ndc.stretched(rays.origins.double(), rays.directions.double(), t, delta))


def _matters_until(p: PassProbe) -> float:
    """The distance up to which a pass has all but a thousandth of its weight: in open space samples go on for ever."""
    total = np.cumsum(p.weights, dtype=np.float64)
    if not len(total) or total[-1] == 0:
        return -np.inf
    return float(p.t[np.searchsorted(total, 0.999 * total[-1])])


def open_ray(method: Method, scene: Scene, camera: Camera, pixel: tuple[int, int], step: int) -> RayProbe:
    """Everything that made integer `pixel` (column, row) of `camera`. Raises UserError outside the picture.

    The pixel runs through the same code as in the full-resolution picture, a tile's share of its neighbours with it, so
    the composited colour is the rendered one. A median is the first sample at which the accumulated weight reaches 0.5.
    """
    column, row = pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise UserError(f"pixel {column}, {row} lies outside the {camera.width}×{camera.height} picture")
    flat = row * camera.width + column
    count = min(method.tile, MOST_RAYS)
    rays, i = tile_rays(camera, scene, flat - flat % count, count), flat % count
    trace, rendered = method.trace(rays), method.render(rays)
    passes = tuple(
        PassProbe(s.name, *(v[i, : s.t.shape[1] if s.count is None else int(s.count[i])].cpu().numpy() for v in (
            s.t, _until(scene, rays, s), s.delta, s.sigma, s.alpha, s.transmittance, s.weights, s.rgb)))
        for s in trace.passes
    )  # fmt: skip
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


def open_radiance(
    method: Method, scene: Scene, ray: RayProbe, camera_up: np.ndarray, point_t: float | None = None
) -> RadianceProbe:
    """The colours that the point at distance `point_t` of `ray` emits.

    None: at the median depth, else at the strongest sample; where there is none, in the middle of the ray.
    The network takes d, camera to point; the plot is over v = −d. `camera_up` (3,) turns the disc upright.
    """
    t = ray.point_t() if point_t is None else point_t
    point = ray.origin.astype(np.float64) + t * ray.direction.astype(np.float64)
    axes = _facing(-ray.direction.astype(np.float64), camera_up)
    pole = scene.up / np.linalg.norm(scene.up)
    azimuth0 = _facing(pole, axes[0])[1]
    directions = np.concatenate([_sphere(pole, azimuth0), _disc(axes)])
    rgb = method.radiance(torch.from_numpy(point), torch.from_numpy(-directions)).cpu().numpy()
    return RadianceProbe(ray.step, point, float(t), directions, rgb, axes, pole, azimuth0)


def _facing(towards: np.ndarray, hint: np.ndarray) -> np.ndarray:
    """Rows right, up, towards: a right-handed frame whose up leans to `hint` as far as it can."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(hint, towards)
    if np.linalg.norm(right) < 1e-6:  # the hint lies along the direction itself: any other axis will do
        right = np.cross(np.eye(3)[int(np.argmin(np.abs(towards)))], towards)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _sphere(pole: np.ndarray, azimuth0: np.ndarray) -> np.ndarray:
    polar = (np.arange(SPHERE_ROWS) + 0.5) / SPHERE_ROWS * np.pi
    azimuth = (np.arange(SPHERE_COLUMNS) + 0.5) / SPHERE_COLUMNS * 2 * np.pi
    polar, azimuth = (v.reshape(-1, 1) for v in np.meshgrid(polar, azimuth, indexing="ij"))
    around = np.cos(azimuth) * azimuth0 + np.sin(azimuth) * np.cross(pole, azimuth0)
    return np.cos(polar) * pole + np.sin(polar) * around


def _disc(axes: np.ndarray) -> np.ndarray:
    x, y, inside = disc_grid()
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1 - x * x - y * y)], -1) @ axes


def inspection(ray: RayProbe, radiance: RadianceProbe) -> dict[str, object]:
    """Everything of both probes as JSON values: finite numbers, null for what is not defined, lists of lists."""
    return finite(
        {
            "step": ray.step,
            "pixel": list(ray.pixel),
            "origin": ray.origin,
            "direction": ray.direction,
            "near": ray.near,
            "far": ray.far,
            "background": ray.background,
            "passes": [{f.name: getattr(one, f.name) for f in fields(one)} for one in ray.passes],
            "color": ray.color,
            "opacity": ray.opacity,
            "depth_expected": ray.depth_expected,
            "depth_median": ray.depth_median,
            "rendered_color": ray.rendered_color,
            "radiance": {
                "point": radiance.point,
                "t": radiance.t,
                "directions": radiance.directions,
                "rgb": radiance.rgb,
            },
        }
    )
