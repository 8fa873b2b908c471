"""Choose the training photo whose camera is nearest, and look its pixels up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.language import phrase
from nerf_core.common.text import number
from nerf_core.geometry.camera import Camera, project
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.nearest_view.config import NearestViewConfig

LEAST_OUT = 1e-9  # of the scene's radius: the least ρ. An eye at the centre then goes by distance alone.
ROUNDING = 1e-5  # of the scene's radius: origins that differ by less are one place, because rays are float32
TIE = 9  # decimals of D: photos at equal distances differ by rounding, which must not choose between them
HERE = 1e-6  # of D: a camera this near to a photo's is that camera, but for rounding
RAYS = 1024  # pixels whose error `train` measures
FILLING = 8  # photos that are asked for a pixel that is masked; farther ones show something else there


class Ranking(NamedTuple):
    """How near N photos were taken to a camera, the nearest first.

    views: (N,) int64 indices into `Scene.views`.
    distance: (N,) D, without unit; see `NearestViewModel`.
    apart: (N,) between the cameras' centres, in world units.
    aside: (N,) the angle between the optical axes, in radians.
    """

    views: np.ndarray
    distance: np.ndarray
    apart: np.ndarray
    aside: np.ndarray


class Pixels(NamedTuple):
    """Where R rays meet a photo.

    places: (R, 2) float64 position in the photo, in pixels.
    inside: (R,) whether the photo shows something there.
    color: (R, 3) float32, the photo's pixel; the background outside, and where it is masked.
    masked: (R,) whether they meet a pixel that is masked.
    """

    places: np.ndarray
    inside: np.ndarray
    color: np.ndarray
    masked: np.ndarray


class NearestViewModel(Defaults):
    """The nearest training photo, pixel for pixel.

    A picture shows one photo: that with the smallest distance D between its camera and the asked one,

        D² = (‖o − o_k‖ / ρ)² + θ_k²

    where o and o_k are the cameras' centres, ρ is how far the asked camera is from the scene's centre, and θ_k is the
    angle between the optical axes. A step around the scene by a small angle is ρ times that angle, so that it counts
    like a turn by the angle. Of equally near photos it is the first.

    A ray's direction in the asked camera's frame is drawn into the photo with the photo's own focal length and lens.
    The pixel there is taken as it is, without interpolation. So the picture of a training camera is its photo. Outside
    of the photo there is only background. A masked pixel is a hole, which the next nearest of FILLING photos fills that
    shows something there. A photo has no depth.

    faced: the camera whose pictures it draws; None: `render` takes a photo for each ray.
    """

    alone: ClassVar[bool] = True
    tile = 16384  # takes a few milliseconds

    def __init__(self, scene: Scene, config: NearestViewConfig, device: torch.device, seed: int) -> None:
        self.config, self.device, self.scene = config, torch.device("cpu"), scene
        self.views = np.array(scene.trained(config.train_images), np.int64)
        self.poses = scene.poses[self.views]
        self.background = np.array(scene.background, np.float32)
        self.faced: Camera | None = None
        self.photo = -1  # the view that `faced` sees
        self._order = self.views[:0]  # the views that `faced` sees, the nearest first

    # ---- which photo ---------------------------------------------------------------------------------------------

    def ranking(self, camera: Camera) -> Ranking:
        """Return all photos by their distance D to a camera."""
        apart = np.linalg.norm(self.poses[:, :, 3] - camera.c2w[:, 3], axis=-1)
        aside = _angle(-self.poses[:, :, 2], -camera.c2w[:, 2])
        out = float(np.linalg.norm(camera.c2w[:, 3] - self.scene.center))
        distance = np.hypot(apart / max(out, LEAST_OUT * self.scene.radius), aside)
        order = np.argsort(distance.round(TIE), kind="stable")
        return Ranking(self.views[order], distance[order], apart[order], aside[order])

    def facing(self, camera: Camera) -> Self:
        other = copy(self)
        other.faced, other._order = camera, self.ranking(camera).views
        other.photo = int(other._order[0])
        return other

    def caption(self, camera: Camera) -> str:
        nearest = self.ranking(camera)
        name = self.scene.views[int(nearest.views[0])].name
        if nearest.distance[0] < HERE:
            return phrase("the training photo {name}, taken from here", name=name)
        return phrase(
            "the nearest training photo: {name} ({aside:.0f}° aside, {apart} units away)",
            name=name,
            aside=np.degrees(nearest.aside[0]),
            apart=number(float(nearest.apart[0]), 2),
        )

    def frozen(self) -> Self:
        return copy(self)  # nothing changes, and a deep copy would hold all photos again

    # ---- its pixels ----------------------------------------------------------------------------------------------

    def look_up(self, view: int, local: np.ndarray) -> Pixels:
        """Return what a photo shows in directions (R, 3), given in its camera's axes."""
        camera = self.scene.views[view].camera
        done = project(local, np.array(camera.intrinsics(), np.float64))
        inside, masked = done.framed & done.shown, np.zeros(len(local), bool)
        if (mask := self.scene.photos.mask(view)) is not None:
            column, row = np.floor(done.pixels[inside]).astype(np.int64).T
            masked[inside] = ~mask[row, column]
            inside &= ~masked
        color = np.broadcast_to(self.background, (len(local), 3)).copy()
        column, row = np.floor(done.pixels[inside]).astype(np.int64).T
        color[inside] = self.scene.photos.part(view, row, column) / np.float32(65535)
        return Pixels(done.pixels, inside, color, masked)

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        """Render rays: those of the faced camera, else any.

        Without a faced camera, each ray is looked up in the photo that was taken nearest to its origin; of photos taken
        from the same place, in the one whose optical axis is nearest to the ray. Its direction is then the one in the
        world, so that a ray of a training photo finds its own pixel too.
        """
        color, opacity = np.empty((len(rays), 3), np.float32), np.empty(len(rays), np.float32)
        for index, _, found in self.looks(rays):
            color[index], opacity[index] = found.color, found.inside
        return Rendering(torch.from_numpy(color), torch.from_numpy(opacity), torch.full((len(rays),), torch.nan))

    def looks(self, rays: Rays) -> Iterator[tuple[np.ndarray, int, Pixels]]:
        """Yield for each photo that rays show: the indices (K,) of these rays, the view, and what they show of it.

        A ray that meets a masked pixel goes on to the next photo, and after the last shows none.
        """
        for group, order, local in self._groups(rays):
            index = group
            for view in order.tolist():
                found = self.look_up(view, local(view)[index])
                last = view == order[-1]
                done = ~found.masked | last
                yield index[done], view, Pixels(*(values[done] for values in found))
                index = index[~done]
                if not len(index):
                    break

    def _groups(self, rays: Rays) -> Iterator[tuple[np.ndarray, np.ndarray, Callable[[int], np.ndarray]]]:
        """Yield for rays that begin with the same photo: their indices (K,), and the views to ask, one after the other.

        The third value gives the directions (R, 3) of all rays in the axes of a view's camera.
        """
        origins, directions = (v.double().cpu().numpy() for v in (rays.origins, rays.directions))
        if self.faced is not None:
            turned = directions @ self.faced.c2w[:, :3]
            yield np.arange(len(origins)), self._asked(self._order), lambda _: turned
            return
        places, place_of = np.unique(origins, axis=0, return_inverse=True)
        chosen = np.zeros(len(origins), np.int64)
        for k, place in enumerate(places):
            index = np.flatnonzero(place_of.ravel() == k)
            apart = np.linalg.norm(self.poses[:, :, 3] - place, axis=-1)
            nearest = np.flatnonzero(apart <= apart.min() + ROUNDING * self.scene.radius)
            aside = directions[index] @ self.poses[nearest, :, 2].T  # the cosine to the backward axis: small is near
            chosen[index] = nearest[aside.argmin(1)]
        for view in self.views[np.unique(chosen)].tolist():
            index = np.flatnonzero(self.views[chosen] == view)
            order = self.ranking(self.scene.views[view].camera).views if self.scene.photos.masked_photos else self.views
            order = self._asked(np.concatenate([[view], order[order != view]]))
            yield index, order, lambda view: directions @ self.scene.views[view].camera.c2w[:, :3]

    def _asked(self, order: np.ndarray) -> np.ndarray:
        """The views of an order that are asked: one alone where nothing is masked."""
        return order[: FILLING if self.scene.photos.masked_photos else 1]

    # ---- training, of which there is none ------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        return Draw(RAYS)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Return the mean squared error of the rays' colours. Nothing changes: there are no parameters."""
        error = torch.nn.functional.mse_loss(self.render(rays).color, truth.cpu()).item()
        yield_callback()
        return error

    def state(self) -> dict[str, Tensor]:
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        if state:
            raise ValueError(f"a nearest photo has no state, but here are {', '.join(state)}")

    def parameters(self) -> list[Tensor]:
        return []


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (N,) between unit vectors (N, 3) and (3,), in radians. Equal ones give exactly 0."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), a @ b)
