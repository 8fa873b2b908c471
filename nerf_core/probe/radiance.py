"""The colours that one point emits over all directions, and those that the whole ray would show, as plain arrays."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Dense, Radiant
from nerf_core.probe.directions import SPHERE_COLUMNS, SPHERE_ROWS, Around, RadianceProbe, disc_grid
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.rendering.view_dependence import view_dependence

# The share of a ray's weight that is evaluated anew for each direction. The rest changes a pixel by at most half an
# 8-bit step.
FROZEN_WEIGHT = 0.998
FROZEN_PAIRS = 1 << 16  # pairs of a sample and a direction that are evaluated at once: some 100 MB with a network
STEEP = 1e-6  # there is no normal where σ changes by no more than this share over a sample's length


def open_radiance(
    method: Radiant,
    scene: Scene,
    ray: RayProbe,
    camera_up: np.ndarray,
    point_t: float | None = None,
    around: Around = "viewer",
) -> RadianceProbe:
    """Return the colours that a point of an opened ray emits over all directions.

    Args:
        method: a model that has a radiance at a point.
        scene: its scene.
        ray: the opened ray.
        camera_up: (3,) the camera's upward direction in the world; the disc is drawn with it upright.
        point_t: the point's world distance along the ray. None takes the median depth, else the strongest sample,
            else the middle of the ray.
        around: the direction at the disc's centre: "viewer" for the one to the camera, or "normal" for the density's
            normal. Where there is no normal, it is the viewer.

    Returns:
        Colours over directions v, from the point outwards.
    """
    t = ray.point_t() if point_t is None else point_t
    origin, along = ray.origin.astype(np.float64), ray.direction.astype(np.float64)
    point, last = origin + t * along, ray.passes[-1]
    normal = density_normal(method, point, _length_at(last, t, scene), -along)
    axes = _facing(normal if around == "normal" and normal is not None else -along, camera_up)
    pole = scene.up / np.linalg.norm(scene.up)
    azimuth0 = _facing(pole, axes[0])[1]
    directions = np.concatenate([_sphere(pole, azimuth0), _disc(axes)])
    looking = torch.from_numpy(-directions)
    every = torch.cat([looking, torch.from_numpy(along)[None]])
    rgb, back = np.split(method.radiance(torch.from_numpy(point)[None], every)[0].cpu().numpy(), [-1])
    frozen = _frozen(method, ray, looking)
    dependence = float(view_dependence(method, torch.from_numpy(point)[None], torch.from_numpy(-along)[None])[0])
    return RadianceProbe(
        ray.step, point, float(t), directions, rgb, back[0], frozen, axes, pole, azimuth0, normal, around, dependence
    )


def density_normal(method: Radiant | Dense, point: np.ndarray, length: float, towards: np.ndarray) -> np.ndarray | None:
    """Return the normal of the density at a point: ±∇σ/‖∇σ‖, by central differences.

    The sign is chosen towards the viewer, because a thin sheet has equal gradients on both sides.

    Args:
        method: the model.
        point: (3,) in world units.
        length: the step to either side, in world units.
        towards: (3,) direction to the viewer.

    Returns:
        (3,) float64, of unit length. None if σ is constant there, or if the method has no density at a point.
    """
    if not isinstance(method, Dense):
        return None
    offsets = length * np.concatenate([np.eye(3), -np.eye(3)])
    sigma = method.density(torch.from_numpy(point + offsets)).double().cpu().numpy()
    slope = sigma[:3] - sigma[3:]
    size = float(np.linalg.norm(slope))
    if not np.isfinite(size) or size <= STEEP * max(float(sigma.max()), 1e-12):
        return None
    normal = -slope / size
    return normal if normal @ towards >= 0 else -normal


def _length_at(one: PassProbe, t: float, scene: Scene) -> float:
    """Return the length of the sample at t, which is the finest detail of the density there.

    It is limited to between 0.0001 and 0.01 of the scene's radius.
    """
    most = 0.01 * scene.radius
    if not len(one.t):
        return most
    k = max(int(np.searchsorted(one.t, t, side="right")) - 1, 0)
    return float(np.clip(np.nan_to_num(one.until[k] - one.t[k], posinf=most), 0.01 * most, most))


def _frozen(method: Radiant, ray: RayProbe, looking: Tensor) -> np.ndarray:
    """Return Σ w_i c(x_i, d) + (1 − Σ w_i) background over ray directions d (K, 3), as (K, 3) float32."""
    last = ray.passes[-1]
    order = np.argsort(-last.weights, kind="stable")
    reach = np.cumsum(last.weights[order], dtype=np.float64)
    needed = int(np.searchsorted(reach, FROZEN_WEIGHT * reach[-1])) + 1 if len(reach) else 0
    kept, rest = np.split(order, [needed])
    color = last.weights[rest].astype(np.float64) @ last.rgb[rest] + (1 - ray.opacity) * ray.background
    total, done = torch.from_numpy(color).float().expand(len(looking), 3).clone(), 0
    points = ray.origin.astype(np.float64) + last.t[kept, None].astype(np.float64) * ray.direction.astype(np.float64)
    weights = torch.from_numpy(last.weights[kept]).float()
    for part in looking.split(max(1, FROZEN_PAIRS // needed)) if needed else ():
        rgb = method.radiance(torch.from_numpy(points), part).cpu().float()
        total[done : done + len(part)] += torch.einsum("p,pkc->kc", weights, rgb)
        done += len(part)
    return total.numpy()


def _facing(towards: np.ndarray, hint: np.ndarray) -> np.ndarray:
    """Return a right-handed frame as rows right, up, towards. Its up is as close to `hint` as possible."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(hint, towards)
    if np.linalg.norm(right) < 1e-6:  # the hint is parallel to the direction: take any other axis
        right = np.cross(np.eye(3)[int(np.argmin(np.abs(towards)))], towards)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _sphere(pole: np.ndarray, azimuth0: np.ndarray) -> np.ndarray:
    """Return the directions of the sphere map's pixels, row by row: (SPHERE_ROWS · SPHERE_COLUMNS, 3)."""
    polar = (np.arange(SPHERE_ROWS) + 0.5) / SPHERE_ROWS * np.pi
    azimuth = (np.arange(SPHERE_COLUMNS) + 0.5) / SPHERE_COLUMNS * 2 * np.pi
    polar, azimuth = (v.reshape(-1, 1) for v in np.meshgrid(polar, azimuth, indexing="ij"))
    around = np.cos(azimuth) * azimuth0 + np.sin(azimuth) * np.cross(pole, azimuth0)
    return np.cos(polar) * pole + np.sin(polar) * around


def _disc(axes: np.ndarray) -> np.ndarray:
    """Return the directions of the disc's pixels inside the circle, row by row: (K, 3)."""
    x, y, inside = disc_grid()
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1 - x * x - y * y)], -1) @ axes
