"""Learn Flatland from its photos, as the paper learns a scene: two networks, two passes, one loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.configs import check_ranges, constant
from nerf_core.common.language import marked
from nerf_core.lab.flatland.network import FlatNetwork
from nerf_core.lab.flatland.rays import PIXELS, FlatRays, camera_rays, ring
from nerf_core.lab.flatland.world import World
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.volume.compositing import absorb, composite
from nerf_core.volume.sampling import inverse_transform, spaced, stratified

RAYS = 128  # of a step: as many pixels as two photos have
RATE, LAST_RATE = 7e-3, 5e-4  # Adam's learning rate at first and in the end, with an exponential decay between
PIXEL_DEPTH = 0.05  # a pixel of the field's picture shows what this length of the field absorbs


@dataclass(frozen=True)
class FlatConfig:
    """The constants. All but `steps` and `seed` may be turned while it learns.

    steps: of the optimiser.
    frequencies: L of the position. directions: L of the direction.
    coarse, fine: N_c and N_f of a ray; without fine samples, there is only the coarse network.
    cameras: on the ring. noise: of the training photos.
    seed: of weights, noise and batches.
    """

    steps: int = constant(3000, marked("optimiser steps"), least=1, most=10**6)
    frequencies: int = constant(4, marked("frequencies L of the position's encoding; 0: bare coordinates"), most=10)
    directions: int = constant(
        3, marked("frequencies of the direction's encoding; 0: colours are the same from all sides"), most=6
    )
    coarse: int = constant(24, marked("coarse samples of a ray, N_c, evenly spaced"), least=4, most=128)
    fine: int = constant(
        24, marked("fine samples, N_f, where the coarse weights are; 0: the coarse network alone"), most=128
    )
    cameras: int = constant(16, marked("cameras on the ring that take the training photos"), least=2, most=48)
    noise: float = constant(0.0, marked("standard deviation of the noise in the training photos, of 1"), most=0.5)
    seed: int = constant(0, marked("seed of weights, batches and noise"), most=2**31)

    def __post_init__(self) -> None:
        check_ranges(self)


class Pass(NamedTuple):
    """One pass of R rays through a network, each (R, S): distances, densities, α, T and w; colours (R, S, 3).

    color: the composited colour of each ray (R, 3).
    """

    t: Tensor
    sigma: Tensor
    alpha: Tensor
    transmittance: Tensor
    weights: Tensor
    rgb: Tensor
    color: Tensor


class Truth(NamedTuple):
    """The exact photos: rays of all cameras, and their colours (R, 3). First come the training cameras."""

    rays: FlatRays
    colors: Tensor
    training: list[float]
    held_out: list[float]


def truth_of(world: World, cameras: int) -> Iterator[Truth | None]:
    """Take the photos of a ring of cameras. Yields None after each, some 10 ms of work, and in the end the photos."""
    training, held_out = ring(cameras)
    rays, photos = camera_rays(training + held_out), list[Tensor]()
    for part in rays.split(PIXELS):
        photos.append(world.colors(part))
        yield None
    yield Truth(rays, torch.cat(photos), training, held_out)


class FlatFit:
    """Coarse and fine network that learn the photos. One thread owns it.

    config: the constants. steps: how many optimiser steps were made.

    On one processor the same seed and number of threads give the same numbers bit for bit.
    """

    def __init__(self, world: World, truth: Truth, config: FlatConfig) -> None:
        self.world, self.truth, self.config, self.steps = world, truth, config, 0
        start = torch.Generator().manual_seed(config.seed)
        self.networks = {name: FlatNetwork(config.frequencies, config.directions, start) for name in ("coarse", "fine")}
        # one for each network: without fine samples, the fine one has no gradients, and its optimiser no state
        self.optimizers = {name: Adam(net.parameters(), lr=RATE) for name, net in self.networks.items()}
        self.generator = torch.Generator().manual_seed(config.seed + 1)
        grain = torch.Generator().manual_seed(config.seed + 2)  # its own: the photos do not depend on the networks
        noise = torch.randn(len(truth.training) * PIXELS, 3, generator=grain)
        self.photos = truth.colors[: len(noise)] + config.noise * noise

    # ---- the paper's equations --------------------------------------------------------------------------------------

    def passes(self, rays: FlatRays, generator: torch.Generator | None = None) -> list[Pass]:
        """Send rays through the networks: the coarse one, then the fine one if there are fine samples.

        The coarse samples are stratified (NeRF Eq. 2). The fine pass has them too, and N_f draws from the coarse
        weights (Eq. 5 and section 5.2).

        Args:
            rays: (R,).
            generator: of random samples; None: evenly spaced ones and quantiles.
        """
        t = spaced(rays.near, rays.far, self.config.coarse, False)
        if generator is not None:
            t = stratified(t, generator)
        done = [self._pass("coarse", rays, t)]
        if self.config.fine:
            middle, inner = (t[:, 1:] + t[:, :-1]) / 2, done[0].weights[:, 1:-1].detach()
            draws = inverse_transform(middle, inner, self.config.fine, generator)
            done.append(self._pass("fine", rays, torch.cat([t, draws], -1).sort(-1).values))
        return done

    def _pass(self, name: str, rays: FlatRays, t: Tensor) -> Pass:
        """Composite one network's samples at distances t (R, S): NeRF Eq. 3.

        δ is the distance to the next sample. The last one's ends with the ray, because the world ends there.
        """
        sigma, rgb = self.networks[name](rays.points(t), rays.directions)
        sigma, rgb = sigma.view(t.shape), rgb.view(*t.shape, 3)
        delta = torch.cat([t[:, 1:], rays.far[:, None]], -1) - t
        alpha, transmittance, weights = absorb(sigma, delta)
        return Pass(t, sigma, alpha, transmittance, weights, rgb, composite(weights, rgb, self.world.background)[0])

    def step(self) -> float:
        """Make one optimiser step on random pixels of all training photos. Returns the loss before it.

        The loss is that of both passes (NeRF Eq. 6), as a mean over pixels and channels.
        """
        done = min(self.steps / self.config.steps, 1.0)
        chosen = torch.randint(len(self.photos), (RAYS,), generator=self.generator)
        photos = self.photos[chosen]
        loss = torch.stack(
            [(p.color - photos).square().mean() for p in self.passes(self.truth.rays[chosen], self.generator)]
        )
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        loss.sum().backward()
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = RATE * (LAST_RATE / RATE) ** done
            optimizer.step()
        self.steps += 1
        return float(loss.sum().detach())

    # ---- what was learnt --------------------------------------------------------------------------------------------

    @torch.no_grad()
    def photo(self, camera: int) -> np.ndarray:
        """Return what the networks draw of a camera, (PIXELS, 3) float32 in [0, 1]."""
        return self.passes(self.truth.rays[self.pixels(camera)])[-1].color.numpy()

    def pixels(self, camera: int) -> slice:
        """Return where the rays of a camera are; held-out cameras follow the training ones."""
        return slice(camera * PIXELS, (camera + 1) * PIXELS)

    @torch.no_grad()
    def field(self, side: int, camera: int) -> np.ndarray:
        """Draw the learnt field as a camera sees it; see `field_picture`."""
        network = self.networks["fine" if self.config.fine else "coarse"]
        return field_picture(network, self.truth.rays.origins[camera * PIXELS], side, self.world.background)

    # ---- files ------------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Return networks, optimiser and random state, for a file. The config is kept beside it."""
        nets = {f"{name}.{key}": v for name, net in self.networks.items() for key, v in net.state_dict().items()}
        moments = {
            f"{name}.{key}": v for name, one in self.optimizers.items() for key, v in adam_state(one).items()
        }  # fmt: skip
        return nets | moments | {
            "generator": self.generator.get_state(), "steps": torch.tensor(self.steps),
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError, RuntimeError or ValueError if it does not fit."""
        for name, net in self.networks.items():
            own = {key.removeprefix(f"{name}."): value for key, value in state.items() if key.startswith(f"{name}.")}
            net.load_state_dict({key: own[key] for key in net.state_dict()})
            load_adam(self.optimizers[name], list(net.parameters()), own)
        self.generator.set_state(state["generator"])
        self.steps = int(state["steps"])


def field_picture(
    radiance: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], eye: Tensor, side: int, background: Tensor
) -> np.ndarray:
    """Draw a field over the square [−1, 1]², (side, side, 3) float32 in [0, 1]; y grows upwards.

    Each pixel shows the colour times α over the background, with α = 1 − exp(−σ δ) of δ = `PIXEL_DEPTH`.

    Args:
        radiance: returns σ and colour at points, seen in directions.
        eye: (2,) from where it is seen: colours depend on the direction.
        side: pixels.
        background: (3,).
    """
    place = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(-place, place, indexing="ij")
    p = torch.stack([x, y], -1).reshape(-1, 2)
    sigma, rgb = radiance(p, functional.normalize(p - eye, dim=-1))
    alpha = -torch.expm1(-PIXEL_DEPTH * sigma)[:, None]
    return (alpha * rgb + (1 - alpha) * background).reshape(side, side, 3).clamp(0, 1).numpy()
