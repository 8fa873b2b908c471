"""What the training photos know of a point: who sees it, what they show, how the model would stand without it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.camera import BESIDE
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.rays import Rays, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method, Radiant, traced
from nerf_core.probe.ray import MOST_RAYS, sample_ends
from nerf_core.probe.sightings import Sightings

MOST_VIEWS = 256  # that are asked about one point: half of them those that look at it most as the ray does


def _spread(looks: np.ndarray, first: int, most: int) -> np.ndarray:
    """Which of N unit looks (N, 3) to take, `most` of them: the `first`, then the one farthest from all that are taken,
    again and again, so that no direction that somebody looked from is far from all of them. Ascending indices."""
    if len(looks) <= most:
        return np.arange(len(looks))
    taken = list(range(first))
    nearest = np.einsum("nc,kc->nk", looks, looks[:first]).max(-1)  # cosine to the nearest that is taken
    while len(taken) < most:
        taken.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, looks @ looks[taken[-1]])
    return np.sort(taken)


class TrainingViews:
    """A scene's training photos, ready to be asked; made once a scene, for its cameras lie side by side."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.views = np.array(sorted(scene.split("train")), np.int64)
        cameras = [scene.views[i].camera for i in self.views]
        self._cameras = Cameras(cameras, scene.near, scene.far) if cameras else None
        self._c2w = np.array([c.c2w for c in cameras], np.float64).reshape(-1, 3, 4)
        self._intrinsics = np.array([c.intrinsics() for c in cameras], np.float64).reshape(-1, 11)

    def project(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the cameras have a world point (3,): pixels (C, 2), and whether it lies in their frame (C,)."""
        offsets = point - self._c2w[:, :, 3]
        local = np.einsum("cij,ci->cj", self._c2w[:, :, :3], offsets)
        depth = -local[:, 2]
        plane = np.stack([local[:, 0], -local[:, 1]], -1) / np.maximum(depth, 1e-12)[:, None]  # behind: not framed
        width, height, fx, fy, cx, cy, *coefficients = self._intrinsics.T
        lens = Lens(*coefficients)
        plane = np.clip(plane, -BESIDE, BESIDE)
        bent = lens.distort(plane)
        pixels = bent * np.stack([fx, fy], -1) + np.stack([cx, cy], -1)
        if lens.bends:
            depth = np.where(lens.shows(plane, bent), depth, -1.0)
        inside = (pixels >= 0).all(-1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        return pixels, (depth > 0) & inside

    def rays(self, index: np.ndarray, pixels: np.ndarray) -> Rays:
        """Through the centres of the pixels that hold `pixels` (V, 2), of the cameras at `index` (V,) of `views`."""
        assert self._cameras is not None
        centres = torch.from_numpy(np.floor(pixels) + 0.5)
        return self._cameras.rays(torch.from_numpy(index), centres)

    def look(self, method: Method, point: np.ndarray, towards: np.ndarray, margin: float) -> Sightings:
        """Everything the photos know of a world point (3,). towards: (3,) unit, the look that angles are measured from,
        camera to point. margin: how far before the point light must have come; about the thickness of what is there."""
        pixels, framed = self.project(point)
        offsets = point - self._c2w[:, :, 3]
        distance = np.linalg.norm(offsets, axis=-1)
        looks = offsets / np.maximum(distance, 1e-12)[:, None]  # a camera in the point itself looks nowhere
        angle = np.arccos(np.clip(looks @ towards, -1, 1))
        index = np.flatnonzero(framed)
        index = index[np.argsort(angle[index], kind="stable")]
        index = index[_spread(looks[index], MOST_VIEWS // 2, MOST_VIEWS)]
        light, share, predicted = self._traced(method, index, pixels[index], distance[index], margin)
        looking = torch.from_numpy(looks[index])
        emitted = np.full((len(index), 3), np.nan, np.float32)
        if isinstance(method, Radiant):
            emitted = method.radiance(torch.from_numpy(point)[None], looking)[0].cpu().numpy()
        found = Sightings(
            point, margin, len(self.views), int(framed.sum()), self.views[index], pixels[index], distance[index],
            angle[index], -looks[index], light, share, self.observed(index, pixels[index]), predicted, emitted,
        )  # fmt: skip
        return found.at(np.lexsort((found.angle, ~found.seen)))

    def observed(self, index: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """The photos' colours (V, 3) float32 at the pixels that hold `pixels` (V, 2)."""
        colors = np.zeros((len(index), 3), np.float32)
        for k, (view, (x, y)) in enumerate(zip(self.views[index], np.floor(pixels).astype(int), strict=True)):
            colors[k] = self.scene.images[view][y, x] / np.float32(65535)
        return colors

    def _traced(
        self, method: Method, index: np.ndarray, pixels: np.ndarray, distance: np.ndarray, margin: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Transmittance (V,), share (V,) and predicted colour (V, 3)."""
        light, share = np.zeros(len(index)), np.zeros(len(index))
        color = np.zeros((len(index), 3), np.float32)
        if not len(index):
            return light, share, color
        at = torch.from_numpy(distance)
        for part, one in self._opened(method, self.rays(index, pixels)):
            before = one.light_at(at[part] - margin)
            light[part], share[part] = before.numpy(), (before - one.light_at(at[part] + margin)).numpy()
            color[part] = one.trace.rendering.color.cpu().numpy()
        return light, share, color

    def otherwise(
        self, method: Method, seen: Sightings, reaches: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pixels of `seen` as they would be without what begins at the point, with it opaque, and with nothing from
        there on.

        Without, (B, V, 3), one for each of B reaches: the stretch from `margin` before the point to `reach` behind it
        is taken out of the pixel's ray. What is left is the part in front of it, and, as far as light comes to the
        point, a ray that begins behind it. Opaque, (V, 3): the part in front, then what comes from there on, scaled up
        until no background is left. Bare, (V, 3): the part in front, then the background.
        """
        if not len(seen.views):
            nothing = np.zeros((0, 3), np.float32)
            return np.zeros((len(reaches), 0, 3), np.float32), nothing, nothing
        rays = self.rays(np.searchsorted(self.views, seen.views), seen.pixels)
        distance, light = torch.from_numpy(seen.distance), torch.from_numpy(seen.transmittance)
        front, opaque = torch.zeros(len(rays), 3), torch.zeros(len(rays), 3)
        for part, one in self._opened(method, rays):
            front[part] = one.color_until(distance[part] - seen.margin)
            end = torch.full_like(distance[part], torch.inf)
            kept = (light[part] - one.light_at(end)).clamp(min=1e-6)  # of less than that nothing is seen
            behind = one.color_until(end) - front[part]
            opaque[part] = front[part] + (light[part] / kept).float()[:, None] * behind
        without = []
        for reach in reaches.tolist():
            rest = method.render(self.beginning(rays, distance + reach))
            without.append(front + light.float()[:, None] * rest.color.cpu())
        bare = front + light.float()[:, None] * torch.tensor(self.scene.background)
        return torch.stack(without).numpy(), opaque.clamp(0, 1).numpy(), bare.numpy()

    def beginning(self, rays: Rays, begin: Tensor) -> Rays:
        """The same rays (V) from world distances `begin` (V,) on."""
        begin = begin.clamp(min=0).float()
        if self.scene.ndc is not None:  # there a ray begins where its origin lies: t is then counted from there
            return replace(rays, origins=rays.origins + begin[:, None] * rays.directions)
        near = torch.maximum(rays.near, begin)
        return replace(rays, near=near, far=torch.maximum(rays.far, near))

    def _opened(self, method: Method, rays: Rays) -> Iterator[tuple[slice, OpenedRays]]:
        """A piece of the rays at a time."""
        piece = min(method.tile, MOST_RAYS)
        for first in range(0, len(rays), piece):
            part = slice(first, first + piece)
            yield part, OpenedRays.of(self.scene, rays[part], traced(method, rays[part]))


@dataclass(frozen=True)
class OpenedRays:
    """Traced rays, to be asked about what lies up to some distance: t, until, tau (R, S) float64, world and optical."""

    trace: Trace
    t: Tensor
    until: Tensor
    tau: Tensor

    @staticmethod
    def of(scene: Scene, rays: Rays, trace: Trace) -> OpenedRays:
        last = trace.passes[-1]
        tau = (last.sigma.double() * last.delta.double()).cpu()
        return OpenedRays(trace, last.t.double().cpu(), sample_ends(scene, rays, last), tau)

    def _covered(self, end: Tensor) -> Tensor:
        """Which share (R, S) of each sample's stretch lies in front of `end` (R,)."""
        length = (self.until - self.t).clamp(min=1e-12)  # a sample of no length is in front or behind as a whole
        return ((end[:, None] - self.t) / length).clamp(0, 1)

    def light_at(self, end: Tensor) -> Tensor:
        """Transmittance (R,) up to world distances `end` (R,): exp(−Σ τ_i), a sample that holds `end` in part."""
        return torch.exp(-(self.tau * self._covered(end)).sum(-1))

    def color_until(self, end: Tensor) -> Tensor:
        """What the stretch up to `end` (R,) shows, without any background: (R, 3)."""
        last = self.trace.passes[-1]
        weights = last.transmittance.cpu() * -torch.expm1(-self.tau * self._covered(end)).float()
        return torch.einsum("rs,rsc->rc", weights, last.rgb.cpu())
