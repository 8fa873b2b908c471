"""Ask the training photos about a point.

Which of them see it, what do they show there, and what would the model show in their pixels without it?
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.camera import INTRINSICS, project
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.rays import Rays, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method, Radiant, traced
from nerf_core.probe.ray import MOST_RAYS, sample_ends
from nerf_core.probe.sightings import Sightings

Exposures = Mapping[int, tuple[np.ndarray, np.ndarray]]
OPAQUE = 1 - 1e-12  # leaves a share of light that no picture shows
MOST_VIEWS = 256  # photos asked about one point; half of them are those nearest in angle to the ray


def _spread(looks: np.ndarray, first: int, most: int) -> np.ndarray:
    """Choose `most` of N unit directions (N, 3): the first `first`, then repeatedly the one farthest from those chosen.

    So no direction is far from all that are chosen. Returns ascending indices.
    """
    if len(looks) <= most:
        return np.arange(len(looks))
    taken = list(range(first))
    nearest = np.einsum("nc,kc->nk", looks, looks[:first]).max(-1)  # cosine to the nearest chosen direction
    while len(taken) < most:
        taken.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, looks @ looks[taken[-1]])
    return np.sort(taken)


class TrainingViews:
    """The training photos of a scene, prepared for questions about points. Make it once for a scene.

    scene: the scene.
    views: (C,) the training views as indices into `Scene.views`, ascending.
    exposures: gains and offsets (3,) by view, of exposures that were learnt; other photos have 1 and 0.
    """

    def __init__(self, scene: Scene, exposures: Exposures | None = None) -> None:
        """Stack the cameras of the training views into arrays.

        Args:
            scene: the scene; its split "train" names the photos.
            exposures: those of `Trainer.exposures`; None: there are none.
        """
        self.exposures: Exposures = exposures or {}
        self.scene = scene
        self.views = np.array(sorted(scene.split("train")), np.int64)
        cameras = [scene.views[i].camera for i in self.views]
        self._cameras = Cameras(cameras, scene.near, scene.far) if cameras else None
        self._c2w = np.array([c.c2w for c in cameras], np.float64).reshape(-1, 3, 4)
        self._intrinsics = np.array([c.intrinsics() for c in cameras], np.float64).reshape(-1, INTRINSICS)

    def project(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project a world point into all C training photos.

        Args:
            point: (3,) in world units.

        Returns:
            Column and row (C, 2) in pixels, and whether the point lies in the photo's frame, bool (C,). A point behind
            the camera, or one that the lens does not show, is in no frame; its pixel then means nothing.
        """
        offsets = point - self._c2w[:, :, 3]
        local = np.einsum("cij,ci->cj", self._c2w[:, :, :3], offsets)
        done = project(local, self._intrinsics)
        return done.pixels, done.framed & done.shown

    def rays(self, index: np.ndarray, pixels: np.ndarray) -> Rays:
        """Return the rays through the centres of the pixels that hold given positions.

        Args:
            index: (V,) positions in `views`, one for each ray.
            pixels: (V, 2) column and row, anywhere in the pixel.

        Returns:
            V rays.
        """
        assert self._cameras is not None
        centres = torch.from_numpy(np.floor(pixels) + 0.5)
        return self._cameras.rays(torch.from_numpy(index), centres)

    def look(self, method: Method, point: np.ndarray, towards: np.ndarray, margin: float) -> Sightings:
        """Return what the photos show of a world point.

        Args:
            method: the model; it predicts the photos' pixels and the transmittance up to the point.
            point: (3,) in world units.
            towards: (3,) unit, from which angles are measured: the ray's direction, from its camera to the point.
            margin: half the length of the stretch that counts as the point, in world units. Transmittance is taken
                at its beginning, because the surface itself must not count as an obstacle.

        Returns:
            The photos that have the point in their frame and not masked, at most MOST_VIEWS of them. Those of a large
            capture that are still to be read are left out.

        Raises:
            UserError: the method keeps no samples along a ray.
        """
        pixels, framed = self.project(point)
        framed &= self.scene.photos.at(self.views.tolist()).present()
        offsets = point - self._c2w[:, :, 3]
        distance = np.linalg.norm(offsets, axis=-1)
        looks = offsets / np.maximum(distance, 1e-12)[:, None]  # a camera in the point itself has no direction
        angle = np.arccos(np.clip(looks @ towards, -1, 1))
        index = np.flatnonzero(framed)
        shown = self.counting(index, pixels[index])
        masked, index = int((~shown).sum()), index[shown]
        found_in = len(index)
        index = index[np.argsort(angle[index], kind="stable")]
        index = index[_spread(looks[index], MOST_VIEWS // 2, MOST_VIEWS)]
        light, share, predicted = self._traced(method, index, pixels[index], distance[index], margin)
        looking = torch.from_numpy(looks[index])
        emitted = np.full((len(index), 3), np.nan, np.float32)
        if isinstance(method, Radiant):
            emitted = method.radiance(torch.from_numpy(point)[None], looking)[0].cpu().numpy()
        found = Sightings(
            point, margin, len(self.views), found_in, masked, self.views[index], pixels[index], distance[index],
            angle[index], -looks[index], light, share, self.observed(index, pixels[index]), self.gains(index),
            predicted, emitted, emitted,
        )  # fmt: skip
        return found.at(np.lexsort((found.angle, ~found.seen)))

    def observed(self, index: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return the photos' colours at given positions, (V, 3) float32 in [0, 1], as of the mean exposure.

        Args:
            index: (V,) positions in `views`.
            pixels: (V, 2) column and row, anywhere in the pixel; they must lie in the photo.
        """
        colors = np.zeros((len(index), 3), np.float32)
        for k, (view, (x, y)) in enumerate(zip(self.views[index], np.floor(pixels).astype(int), strict=True)):
            colors[k] = self.scene.photos.part(view, y, x) / np.float32(65535)
            if (learnt := self.exposures.get(int(view))) is not None:
                colors[k] = np.clip((colors[k] - learnt[1]) / learnt[0], 0, 1)
        return colors

    def gains(self, index: np.ndarray) -> np.ndarray:
        """Return the gains of photos, (V, 3) float32. index: (V,) positions in `views`."""
        gains = np.ones((len(index), 3), np.float32)
        for k, view in enumerate(self.views[index].tolist()):
            if view in self.exposures:
                gains[k] = self.exposures[view][0]
        return gains

    def counting(self, index: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return which positions are not masked, (V,) bool. Arguments are those of `observed`."""
        photos = self.scene.photos
        if photos.kept is None:
            return np.ones(len(index), bool)
        places = zip(self.views[index].tolist(), np.floor(pixels).astype(int).tolist(), strict=True)
        return np.array([photos.counts(view, x, y) for view, (x, y) in places], bool)

    def _traced(
        self, method: Method, index: np.ndarray, pixels: np.ndarray, distance: np.ndarray, margin: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `Sightings.transmittance` (V,), `share` (V,) and `predicted` (V, 3) of the chosen photos."""
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
        """Return the colours of the photos' pixels if the layer at the point were different.

        Let F be the colour of the part of a pixel's ray up to `margin` in front of the point, and T the transmittance
        of that part.

        Args:
            method: the model.
            seen: the V photos to ask.
            reaches: (B,) world distances behind the point at which the layer may end.

        Returns:
            Without the layer, (B, V, 3): F + T × the colour of a ray that begins `reach` behind the point. The stretch
            between the two is left out. One row for each reach.
            With the layer opaque, (V, 3): F + T × the colour of the rest of the ray, which is scaled up until no
            background is left.
            With nothing but background from the layer on, (V, 3): F + T × background.
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
            kept = (light[part] - one.light_at(end)).clamp(min=1e-6)  # less than this is invisible
            behind = one.color_until(end) - front[part]
            opaque[part] = front[part] + (light[part] / kept).float()[:, None] * behind
        without = []
        for reach in reaches.tolist():
            rest = method.render(self.beginning(rays, distance + reach))
            without.append(front + light.float()[:, None] * rest.color.cpu())
        bare = front + light.float()[:, None] * torch.tensor(self.scene.background)
        return torch.stack(without).numpy(), opaque.clamp(0, 1).numpy(), bare.numpy()

    def beginning(self, rays: Rays, begin: Tensor) -> Rays:
        """Return V rays that begin farther along.

        Args:
            rays: V rays.
            begin: (V,) world distances along them; negative ones count as 0.

        Returns:
            The rays with `near` raised to `begin`. Under NDC the origin moves in place of `near`, so that distances
            count from there.
        """
        begin = begin.clamp(min=0).float()
        if self.scene.ndc is not None:  # NDC ignores near: the ray begins at its origin, from which t then counts
            return replace(rays, origins=rays.origins + begin[:, None] * rays.directions)
        near = torch.maximum(rays.near, begin)
        return replace(rays, near=near, far=torch.maximum(rays.far, near))

    def _opened(self, method: Method, rays: Rays) -> Iterator[tuple[slice, OpenedRays]]:
        """Trace the rays in pieces. Yields each piece's slice and its traced rays."""
        piece = min(method.tile, MOST_RAYS)
        for first in range(0, len(rays), piece):
            part = slice(first, first + piece)
            yield part, OpenedRays.of(self.scene, rays[part], traced(method, rays[part]))


@dataclass(frozen=True)
class OpenedRays:
    """R traced rays that give transmittance and colour up to any distance.

    trace: the rays' pixels and samples. Only the last pass is used.
    t: (R, S) float64, where a sample's stretch begins, as a world distance.
    until: (R, S) float64, where it ends, as a world distance.
    tau: (R, S) float64, the stretch's optical depth −ln(1 − α): σδ where density absorbs exponentially.
    """

    trace: Trace
    t: Tensor
    until: Tensor
    tau: Tensor

    @staticmethod
    def of(scene: Scene, rays: Rays, trace: Trace) -> OpenedRays:
        """Prepare R rays and the trace that `method.trace(rays)` returned."""
        last = trace.passes[-1]
        # from α and not from σδ, because not every method's α is 1 − exp(−σδ): opacities may add up to 1, say.
        # OPAQUE keeps τ finite: 0 times infinity is no number.
        tau = -torch.log1p(-last.alpha.double().cpu().clamp(max=OPAQUE))
        return OpenedRays(trace, last.t.double().cpu(), sample_ends(scene, rays, last), tau)

    def _covered(self, end: Tensor) -> Tensor:
        """Return the share (R, S) of each sample's stretch that lies in front of `end` (R,)."""
        length = (self.until - self.t).clamp(min=1e-12)  # a sample without length lies wholly in front or behind
        return ((end[:, None] - self.t) / length).clamp(0, 1)

    def light_at(self, end: Tensor) -> Tensor:
        """Return the transmittance (R,) up to world distances `end` (R,).

        It is exp(−Σ τ_i). The sample whose stretch contains `end` counts with the part in front of it.
        """
        return torch.exp(-(self.tau * self._covered(end)).sum(-1))

    def color_until(self, end: Tensor) -> Tensor:
        """Return the colour (R, 3) of the stretch up to world distances `end` (R,), without background: Σ w c."""
        last = self.trace.passes[-1]
        weights = last.transmittance.cpu() * -torch.expm1(-self.tau * self._covered(end)).float()
        return torch.einsum("rs,rsc->rc", weights, last.rgb.cpu())
