"""Map a scene into a bounded box, as grids need: world space, normalised device coordinates, or contracted space.

An object has its own box, and a forward-facing capture has the box of NDC. All other captures are contracted: the
content that the cameras surround fills an inner cube. Everything behind it, up to infinity, fills the shell between
that cube and one of twice its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.rays import EMPTY, Rays, Rendering
from nerf_core.geometry.scene import Scene

MOST_NDC = 4.0  # limits the box: a ray almost parallel to the image plane would stretch it without bound
HORIZON = 1e6  # in units of the inner cube: no cell of a grid can tell this distance from infinity


@dataclass(frozen=True)
class BoxRays:
    """R rays x = origins + t · directions in the coordinates of a `Space` before contraction.

    origins: (R, 3) in box coordinates.
    directions: (R, 3) in box coordinates per unit of t, in general not of unit length.
    views: (R, 3) unit view directions in the world.
    near, far: (R,) the interval of t that may hold content; empty (far < near) for a ray that NDC cannot represent.
    """

    origins: Tensor
    directions: Tensor
    views: Tensor
    near: Tensor
    far: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]


@dataclass(frozen=True)
class Space:
    """The box coordinates of a scene. t is the world distance under "world" and "contracted", and t′ under "ndc".

    kind: how world points are mapped.
    center: the world point at the centre of the box; unused under "ndc".
    extent: half the side of the (inner) cube, in world units; 1 under "ndc".
    low, high: (3,) corners of the box, in box coordinates.
    ndc: the frustum under "ndc", else None.
    """

    kind: Literal["world", "ndc", "contracted"]
    center: tuple[float, float, float]
    extent: float
    low: np.ndarray
    high: np.ndarray
    ndc: Ndc | None = None

    @staticmethod
    def of(scene: Scene) -> Space:
        """Return the space in which grids represent a scene.

        It is "ndc" for a scene that is trained in NDC, "world" for an object on a plain background, and "contracted"
        for everything else.
        """
        center = (float(scene.center[0]), float(scene.center[1]), float(scene.center[2]))
        one = np.ones(3)
        if scene.ndc is not None:
            return Space("ndc", (0.0, 0.0, 0.0), 1.0, *_seen(scene, scene.ndc), scene.ndc)
        if scene.synthetic:
            return Space("world", center, (scene.far - scene.near) / 2, -one, one)
        return Space("contracted", center, scene.radius, -2 * one, 2 * one)

    def rays(self, rays: Rays) -> BoxRays:
        """Convert R world rays to box coordinates.

        Under "world" and "contracted", t stays the world distance; under "contracted", far moves to the horizon. Under
        "ndc", t becomes t′, which is 0 on the near plane and 1 at infinity. There a ray that does not look towards −z
        gets far = −1, so that it has no samples.
        """
        if self.ndc is not None:
            origins, directions, exists = self.ndc.rays(rays.origins, rays.directions)
            near = self.ndc.first(rays.origins)
            return BoxRays(origins, directions, rays.directions, near, torch.where(exists, 1.0, -1.0))
        center = torch.tensor(self.center, dtype=torch.float32, device=rays.origins.device)
        far = torch.full_like(rays.far, HORIZON * self.extent) if self.kind == "contracted" else rays.far
        return BoxRays(
            (rays.origins - center) / self.extent, rays.directions / self.extent, rays.directions, rays.near, far
        )

    def world_t(self, rays: Rays, t: Tensor) -> Tensor:
        """Convert t (R, S) along the rays of `rays()` to world distance (R, S)."""
        return t if self.ndc is None else self.ndc.world_t(rays.origins, rays.directions, t)

    def box_t(self, rays: Rays, t: Tensor) -> Tensor:
        """Convert world distance (R,) to t along the rays of `rays()`: the inverse of `world_t`."""
        return t if self.ndc is None else 1 + self.ndc.near / (rays.origins[:, 2] + t * rays.directions[:, 2])

    def rendering(self, rays: Rays, pixel: Tensor) -> Rendering:
        """Turn the kernels' pixels (R, 5), which are colour, opacity and Σ w t, into a rendering with world depth."""
        opacity = pixel[:, 3]
        nothing = opacity < EMPTY
        depth = self.world_t(rays, (pixel[:, 4] / torch.where(nothing, 1.0, opacity))[:, None])[:, 0]
        return Rendering(pixel[:, :3], opacity, torch.where(nothing, torch.nan, depth))

    def points(self, world: Tensor) -> Tensor:
        """Map world points (P, 3) to box coordinates (P, 3), with contraction if this space has one."""
        if self.ndc is not None:
            return self.ndc.point(world)
        x = (world - torch.tensor(self.center, dtype=world.dtype, device=world.device)) / self.extent
        return contract(x) if self.kind == "contracted" else x


def pixel_size(scene: Scene, space: Space) -> float:
    """Return the side of a training photo's pixel at the point the cameras look at, in box coordinates (median)."""
    cameras = [scene.views[i].camera for i in scene.split("train")]
    if space.kind == "ndc":
        return 2 / max(c.width for c in cameras)
    distances = [np.linalg.norm(c.c2w[:, 3] - scene.center) / c.fx for c in cameras]
    return float(np.median(distances)) / space.extent


def _seen(scene: Scene, ndc: Ndc) -> tuple[np.ndarray, np.ndarray]:
    """Opposite corners of the box in NDC that the training photos' rays cross. The rays of the photos' corners suffice,
    because a box is convex."""
    low, high = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])
    for i in scene.split("train"):
        camera = scene.views[i].camera
        x, y = camera.width - 1, camera.height - 1
        rays = camera_rays(camera, scene.near, scene.far, np.array([(0, 0), (x, 0), (0, y), (x, y)]))
        origins, directions, exists = ndc.rays(rays.origins, rays.directions)
        ends = torch.cat([origins[exists], (origins + directions)[exists]]).double().numpy()
        if len(ends):
            low[:2], high[:2] = np.minimum(low[:2], ends.min(0)[:2]), np.maximum(high[:2], ends.max(0)[:2])
    return np.maximum(low, -MOST_NDC), np.minimum(high, MOST_NDC)


def contract(x: Tensor) -> Tensor:
    """Contract all of space into the cube of half-side 2: x (P, 3) → (P, 3).

    x stays where ‖x‖∞ ≤ 1, else it becomes (2 − 1/‖x‖∞) x/‖x‖∞. This is mip-NeRF 360's Eq. 10 (arXiv:2111.12077) with
    the maximum norm, because a ball of that norm is a cube, as a grid needs.
    """
    m = x.abs().amax(-1, keepdim=True)
    s = 1 / m.clamp(min=1)
    return torch.where(m > 1, (2 - s) * s * x, x)
