"""One point and all its directions, opened up as plain arrays: what it emits, and what the whole ray would show."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Dense, Radiant
from nerf_core.probe.directions import SPHERE_COLUMNS, SPHERE_ROWS, Around, RadianceProbe, disc_grid
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.rendering.view_dependence import view_dependence

FROZEN_WEIGHT = 0.998  # of a frozen ray looks around: what the lightest samples make of the rest is half an 8-bit step
FROZEN_PAIRS = 1 << 16  # of a sample and a direction, looked up at once: with a network some 100 MB
STEEP = 1e-6  # of σ: a gradient that changes it by no more over a sample's length points nowhere


def open_radiance(
    method: Radiant,
    scene: Scene,
    ray: RayProbe,
    camera_up: np.ndarray,
    point_t: float | None = None,
    around: Around = "viewer",
) -> RadianceProbe:
    """The colours that the point at distance `point_t` of `ray` emits.

    None: at the median depth, else at the strongest sample; where there is none, in the middle of the ray.
    The network takes d, camera to point; the plot is over v = −d. `camera_up` (3,) turns the disc upright; around: what
    its middle is. Where the density has no normal, it is the viewer.
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
    """±∇σ/‖∇σ‖ at a world point (3,) by central differences over `length` on each side, (3,) float64.

    None: flat, or the method has no density at a point.

    The sign is the one that leans towards `towards` (3,): what is looked at is seen from outside, and of a sheet whose
    two sides fall alike −∇σ has no sign of its own.
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
    """The length of the sample at t: what the density is resolved to there; a hundredth of the scene at most."""
    most = 0.01 * scene.radius
    if not len(one.t):
        return most
    k = max(int(np.searchsorted(one.t, t, side="right")) - 1, 0)
    return float(np.clip(np.nan_to_num(one.until[k] - one.t[k], posinf=most), 0.01 * most, most))


def _frozen(method: Radiant, ray: RayProbe, looking: Tensor) -> np.ndarray:
    """Σ w_i c(x_i, d) + (1 − Σ w_i) background over directions d (K, 3): (K, 3) float32."""
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
