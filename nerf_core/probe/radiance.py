"""The colours that a point, its layer and the whole ray would show in all directions, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Dense, Radiant
from nerf_core.probe.directions import SPHERE_COLUMNS, SPHERE_ROWS, Around, RadianceProbe, disc_grid
from nerf_core.probe.layers import layers_of, weights_in
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.probe.standing import Layer
from nerf_core.rendering.view_dependence import view_dependence

# The share of a mixture that is evaluated anew for each direction. The rest changes a colour by at most half an 8-bit
# step.
EVALUATED = 0.998
PAIRS = 1 << 16  # pairs of a sample and a direction that are evaluated at once: some 100 MB with a network
STEEP = 1e-6  # there is no normal where σ changes by no more than this share over a sample's length


def open_radiance(
    method: Radiant,
    scene: Scene,
    ray: RayProbe,
    camera_up: np.ndarray,
    point_t: float | None = None,
    around: Around = "viewer",
) -> RadianceProbe:
    """Return the colours that a point of an opened ray, its layer and the whole ray show over all directions.

    Args:
        method: a model that has a radiance at a point.
        scene: its scene.
        ray: the opened ray.
        camera_up: (3,) the camera's upward direction in the world; the disc is drawn with it upright.
        point_t: the point's world distance along the ray. None takes `default_t`.
        around: the direction at the disc's centre: "viewer" for the one to the camera, or "normal" for the density's
            normal. Where there is no normal, it is the viewer.

    Returns:
        Colours over directions v, from the point outwards.
    """
    layers = layers_of(ray, scene)
    t = default_t(ray, layers) if point_t is None else point_t
    origin, along = ray.origin.astype(np.float64), ray.direction.astype(np.float64)
    point, last, layer = origin + t * along, ray.last, layer_at(layers, t)
    normal = density_normal(method, point, _length_at(last, t, scene), -along)
    axes = _facing(normal if around == "normal" and normal is not None else -along, camera_up)
    pole = scene.up / np.linalg.norm(scene.up)
    azimuth0 = _facing(pole, axes[0])[1]
    directions = np.concatenate([_sphere(pole, azimuth0), _disc(axes)])
    every = torch.from_numpy(np.concatenate([-directions, along[None]]))
    here, towards = torch.from_numpy(point)[None], torch.from_numpy(-along)[None]
    rgb = method.radiance(here, every)[0].cpu().numpy()
    dependence = float(view_dependence(method, here, towards)[0])
    shares = [last.weights] if layer is None else [last.weights, layer_shares(ray, scene, layer)]
    whole, *mixed = mixtures(method, ray, np.stack(shares), every)
    whole = whole + ((1 - ray.opacity) * ray.background).astype(np.float32)
    layer_rgb, layer_dependence, bounds = rgb, dependence, None
    if layer is not None:
        layer_rgb, bounds = mixed[0], np.array([layer.begin, layer.end])
        layer_dependence = float(view_dependence(LayerRadiance(method, scene, ray, layer), here, towards)[0])
    return RadianceProbe(
        ray.step, point, float(t), directions, rgb[:-1], rgb[-1], dependence, bounds, layer_rgb[:-1], layer_rgb[-1],
        layer_dependence, whole[:-1], axes, pole, azimuth0, normal, around,
        "layer" if layer is not None and point_t is None else "point",
    )  # fmt: skip


def default_t(ray: RayProbe, layers: Sequence[Layer]) -> float:
    """Return the distance of a ray's point: the middle of the weight of the heaviest layer, or `RayProbe.point_t`."""
    heaviest = max(layers, key=lambda layer: layer.weight, default=None)
    return ray.point_t() if heaviest is None else heaviest.t


def layer_at(layers: Sequence[Layer], t: float) -> Layer | None:
    """Return the layer that contains a distance; None if there is none."""
    return next((layer for layer in layers if layer.begin <= t <= layer.end), None)


def layer_shares(ray: RayProbe, scene: Scene, layer: Layer) -> np.ndarray:
    """Return w_i / Σ w (S,) for the samples of the last pass. A sample counts by the part that lies in the layer."""
    weights = weights_in(ray.last, ray.far, scene.radius, layer)
    return weights / weights.sum()


class LayerRadiance:
    """The colour that a layer of a ray shows, as if it were a point: Σ w c(x, d) / Σ w with the weights of the ray."""

    def __init__(self, method: Radiant, scene: Scene, ray: RayProbe, layer: Layer) -> None:
        self._method, self._ray, self._shares = method, ray, layer_shares(ray, scene, layer)[None]

    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the colours (P, K, 3) along K ray directions (K, 3). All points (P, 3) are the same layer."""
        rgb = torch.from_numpy(mixtures(self._method, self._ray, self._shares, directions)[0])
        return rgb.expand(len(points), -1, -1)


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


def mixtures(method: Radiant, ray: RayProbe, shares: np.ndarray, looking: Tensor) -> np.ndarray:
    """Return mixtures of a ray's samples, Σ s_i c(x_i, d), over directions.

    The samples that hold EVALUATED of any mixture's shares are evaluated anew for each direction, once for all
    mixtures. The others keep the colour that they have on the ray.

    Args:
        method: the model.
        ray: an opened ray; its last pass has S samples.
        shares: (G, S) the s of each of G mixtures.
        looking: (K, 3) ray directions d.

    Returns:
        (G, K, 3) float32.
    """
    last = ray.last
    anew = np.zeros(len(last.t), bool)
    for one in shares if len(anew) else ():
        order = np.argsort(-one, kind="stable")
        reach = np.cumsum(one[order], dtype=np.float64)
        anew[order[: int(np.searchsorted(reach, EVALUATED * reach[-1])) + 1]] = True
    kept = np.flatnonzero(anew)
    color = shares[:, ~anew].astype(np.float64) @ last.rgb[~anew]
    total, done = torch.from_numpy(color).float()[:, None].repeat(1, len(looking), 1), 0
    points = ray.origin.astype(np.float64) + last.t[kept, None].astype(np.float64) * ray.direction.astype(np.float64)
    weights = torch.from_numpy(shares[:, kept]).float()
    for part in looking.split(max(1, PAIRS // len(kept))) if len(kept) else ():
        rgb = method.radiance(torch.from_numpy(points), part).cpu().float()
        total[:, done : done + len(part)] += torch.einsum("gp,pkc->gkc", weights, rgb)
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
