"""Scene Representation Networks, trained on a single scene (Sitzmann et al. 2019, arXiv:1906.01618)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import replace
from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.methods.srn.config import SrnConfig
from nerf_core.methods.srn.network import March, SrnNetwork

TILE_PRODUCTS = 1.5e9  # multiplications of one tile on a CPU: about 10 ms on two cores that are fast at bfloat16


class Found(NamedTuple):
    """What R rays found.

    t: (R, N + 1) the distances of the marcher's points, in units of Φ's coordinates.
    features: (R, width) Φ at the last point.
    color: (R, 3) the pixel generator's colour of it, which may leave [0, 1].
    """

    t: Tensor
    features: Tensor
    color: Tensor


def unit_of(scene: Scene) -> float:
    """Return the world length that is 1 in the coordinates of Φ: half the depth of an object, else the radius."""
    return (scene.far - scene.near) / 2 if scene.synthetic else scene.radius


def reach_of(scene: Scene) -> float:
    """Return the median distance of the training cameras from the scene's centre, in world units."""
    views = scene.split("train") or range(len(scene.views))  # the trainer refuses a scene without training photos
    places = scene.poses[list(views), :, 3]
    return float(np.median(np.linalg.norm(places - scene.center, axis=-1)))


def behind_camera(t: Tensor) -> Tensor:
    """The depth regulariser (R,) of final distances t (R,): min(t, 0)², which penalises points behind the camera."""
    return t.clamp(max=0).square()


class SrnModel(Defaults):
    """Φ, marcher and pixel generator of one scene with their optimiser.

    A ray has no samples. The marcher visits some points, and the last one, x_N, is the surface that it claims: the
    colour is that of Φ(x_N) alone. It paints every pixel so, the background too, whose points it puts anywhere. So the
    opacity is 1 everywhere, and the depth is the distance of x_N; a point behind the camera has the depth 0.

    The paper's hypernetwork makes the weights of Φ from a latent code, one for each of many scenes. A single scene
    needs neither: the weights of Φ are trained themselves.
    """

    alone: ClassVar[bool] = False

    def __init__(self, scene: Scene, config: SrnConfig, device: torch.device, seed: int) -> None:
        c = self.config = config
        self.device = device
        self.center = torch.tensor(scene.center, dtype=torch.float32, device=device)
        self.unit = unit_of(scene)
        self.start = c.start * scene.near / self.unit
        precision = torch.bfloat16 if c.precision == "bfloat16" else None
        self.network = SrnNetwork(c.layers, c.generator_layers, c.width, c.hidden, precision)
        step = (reach_of(scene) / self.unit - self.start) / c.march_steps  # the march begins by ending at the centre
        self.network.initialise(torch.Generator().manual_seed(seed), step)
        self.network.to(device)
        self.tile = config.tile or self._fitting_tile()
        self.optimizer = Adam(self.parameters(), lr=c.learning_rate, eps=c.adam_epsilon)
        for parameter in self.parameters():
            parameter.grad = torch.zeros_like(parameter)

    def _fitting_tile(self) -> int:
        """The number of rays whose matrix products are large enough to be efficient and small enough to end soon."""
        if self.device.type != "cpu":
            return 4096
        evaluations = [(self.network.scene, self.config.march_steps + 1), (self.network.generator, 1)]
        ray = sum(times * sum(p.numel() for p in part.parameters()) for part, times in evaluations)
        return 2 ** int(min(max(math.log2(TILE_PRODUCTS / ray), 3), 12))

    def march(self, rays: Rays) -> March:
        """March along R rays. Distances t are in units of Φ's coordinates: `unit` world units each."""
        origins = (rays.origins - self.center) / self.unit
        # the scene's near distance and not the rays': a ray that is opened may begin where the marcher stepped back to
        start = torch.full_like(rays.near, self.start)
        return self.network.march(origins, rays.directions, start, self.config.march_steps)

    # ---- training -------------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: MSE of the colours plus the weighted mean of the depth regulariser."""
        c = self.config
        rate = c.learning_rate * c.decay ** (step / (steps or c.total_steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=False)
        error = torch.zeros((), device=self.device)
        for start in range(0, len(rays), c.chunk_rays):
            chunk = slice(start, start + c.chunk_rays)
            loss, squared = self.loss(rays[chunk], truth[chunk])
            (loss * (len(squared) / len(rays))).backward()
            error = error + squared.sum()
            yield_callback()
        self.optimizer.step()
        return float(error / truth.numel())

    def loss(self, rays: Rays, truth: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of R rays, and their squared errors (R, 3) as a picture has them, with colours in [0, 1]."""
        march = self.march(rays)
        color = self.network.color(march.features)
        loss = (color - truth).square().mean() + self.config.depth_weight * behind_camera(march.t[:, -1]).mean()
        return loss, (color.detach().clamp(0, 1) - truth).square()

    def halve(self) -> bool:
        if self.config.chunk_rays == 1:
            return False
        self.config = replace(self.config, chunk_rays=self.config.chunk_rays // 2)
        return True

    # ---- rendering ------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def found(self, rays: Rays) -> Found:
        """March along any number of rays, always in full tiles, so that a pixel does not depend on its neighbours."""
        parts = []
        for first in range(0, len(rays), self.tile):
            part = rays[first : first + self.tile]
            march = self.march(part.to(self.device).padded(self.tile))
            done = Found(*march, self.network.color(march.features))
            parts.append([value[: len(part)] for value in done])
        return Found(*(torch.cat(values) for values in zip(*parts, strict=True)))

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        found = self.found(rays)
        depth = (found.t[:, -1] * self.unit).clamp(min=0)
        return Rendering(found.color.clamp(0, 1), torch.ones_like(depth), depth)

    def visited(self, rays: Rays) -> Tensor:
        """Return the distances (R, N + 1) in world units of the marcher's points: the start, and one for each step."""
        return self.found(rays).t * self.unit

    # ---- state ----------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        other = copy(self)
        other.network = deepcopy(self.network)
        return other

    def parameters(self) -> list[Tensor]:
        return list(self.network.parameters())

    def state(self) -> dict[str, Tensor]:
        return dict(self.network.state_dict()) | adam_state(self.optimizer)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.network.load_state_dict({name: state[name] for name in self.network.state_dict()})
        load_adam(self.optimizer, self.parameters(), state)
