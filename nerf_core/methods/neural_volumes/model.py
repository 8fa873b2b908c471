"""Neural Volumes for a static scene (Lombardi et al. 2019, arXiv:1906.07751), see the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.methods.neural_volumes.config import NeuralVolumesConfig
from nerf_core.methods.neural_volumes.decoder import Chain, Decoder, Volume, applied, sampled
from nerf_core.methods.neural_volumes.march import Box, March, add_up
from nerf_core.methods.neural_volumes.priors import undecided, variation
from nerf_core.methods.neural_volumes.warp import AffineWarp, FieldWarp
from nerf_core.volume.compositing import composite, expected_depth

TILE = 2**16  # samples drawn at once on a CPU: about 10 ms
CUDA_TILE = 2**21
SLAB = 2**16  # voxels between two yields while the total variation is computed: a few ms
AVERAGE_EVERY = 4  # steps between updates of the EMA of the weights: neighbouring steps differ little
FOLLOW = 0.1  # rate of the EMA per update: it spans about 40 steps
YOUNG = 4.0  # at its update k the EMA spans only the last k/YOUNG updates: older weights are outdated
FEWEST = 2**10  # samples per chunk below which `halve` refuses


class NeuralVolumesModel(Defaults):
    """The latent code and its decoder. They are decoded once a step, and once for all pictures between two steps."""

    def __init__(self, scene: Scene, config: NeuralVolumesConfig, device: torch.device, seed: int) -> None:
        self.config, self.device = config, device
        self.space = Space.of(scene)
        self.box = Box(self.space, device)
        self.background = torch.tensor(scene.background, device=device)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.net = Net(config)
        self.net.initialise(torch.Generator().manual_seed(seed))
        self.net.to(device)
        self.shown = deepcopy(self.net).requires_grad_(False)  # the EMA of the weights, which pictures show
        self.optimizer = Adam(self.parameters(), lr=config.learning_rate)
        for parameter in self.parameters():
            parameter.grad = torch.zeros_like(parameter)
        self._volume: Volume | None = None

    @property
    def step_length(self) -> float:
        """The length of a sample, in units of the box's half side."""
        return self.config.step * 2 / (self.config.template - 1)

    # ---- training -------------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: mean squared error and the priors, Adam on the latent code and the decoder."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate / (1 + step / self.config.slowdown)
        self.optimizer.zero_grad(set_to_none=False)
        offsets = torch.rand(len(rays), generator=self.generator).to(self.device)
        chains = self.net.chains(yield_callback)
        volume = Volume(*(chain.value for chain in chains), *([None] * (2 - len(chains))))
        error = self._rays(volume, rays.to(self.device), truth.to(self.device), offsets, yield_callback)
        if self.config.tv_weight:
            slab = max(1, SLAB // self.config.template**2)
            for part in variation(volume.template[0, 3], slab):
                (self.config.tv_weight * part).backward()
                yield_callback()
        for chain in chains:
            gradient = chain.backward(yield_callback)
            assert self.net.latent.grad is not None
            self.net.latent.grad += gradient
        self.optimizer.step()
        if (step + 1) % AVERAGE_EVERY == 0:
            self._average((step + 1) // AVERAGE_EVERY)
        return error / truth.numel()

    def _rays(
        self, volume: Volume, rays: Rays, truth: Tensor, offsets: Tensor, yield_callback: Callable[[], None]
    ) -> float:
        """Add the gradient of all rays to the volume's, in chunks. Returns the summed squared error."""
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        chunk = max(1, int(self.config.chunk * self.step_length / 2))
        for start in range(0, len(rays), chunk):
            part = slice(start, start + chunk)
            march = self.box.march(rays[part], self.step_length, offsets[part])
            opacity, rgb = looked_up(volume, march)
            color, total = composite(add_up(opacity)[1], rgb, self.background)
            squares = (color - truth[part]).square().sum()
            loss = squares / truth.numel()
            if self.config.opacity_prior:
                loss = loss + self.config.opacity_prior * undecided(total).sum() / len(rays)
            loss.backward()
            error += squares.detach()
            yield_callback()
        return float(error)

    @torch.no_grad()
    def _average(self, move: int) -> None:
        """Move the EMA towards the weights, for the time number `move` (from 1)."""
        share = max(FOLLOW, YOUNG / (YOUNG + move - 1))
        for mean, now in zip(self.shown.parameters(), self.net.parameters(), strict=True):
            mean.lerp_(now, share)
        self._volume = None

    def halve(self) -> bool:
        if self.config.chunk <= FEWEST:
            return False
        self.config = replace(self.config, chunk=self.config.chunk // 2)
        return True

    # ---- rendering ------------------------------------------------------------------------------------------------

    @property
    def tile(self) -> int:
        samples = TILE if self.device.type == "cpu" else CUDA_TILE
        return max(1, int(samples * self.step_length / 2))

    @property
    def volume(self) -> Volume:
        """The volume that the EMA of the weights decodes to. It is kept until they change."""
        if self._volume is None:
            with torch.no_grad():
                self._volume = self.shown.volume()
        return self._volume

    def trace(self, rays: Rays) -> Trace:
        return self._tile(rays, hidden=True)

    @torch.no_grad()
    def _tile(self, rays: Rays, hidden: bool) -> Trace:
        """Composite rays; hidden: whether samples that do not count show what the volume holds there."""
        rays = rays.to(self.device)
        march = self.box.march(rays, self.step_length, torch.full_like(rays.near, 0.5))
        opacity, rgb = (
            laid_out(march, march.real, *self.volume.at(march.u)) if hidden else looked_up(self.volume, march)
        )
        transmittance, weights = add_up(opacity)
        color, total = composite(weights, rgb, self.background)
        t, delta = self.space.world_t(rays, march.t), march.delta
        if self.space.kind == "ndc":  # δ in NDC
            delta = delta * self.space.rays(rays).directions.norm(dim=-1)[:, None]
        empty = transmittance <= 0
        alpha = torch.where(empty, 0, weights / torch.where(empty, 1, transmittance))
        sigma = opacity / torch.where(march.real, delta, 1)
        samples = Samples(marked("volume"), t, delta, sigma, alpha, transmittance, weights, rgb, march.real.sum(-1))
        return Trace(Rendering(color.clamp(0, 1), total, expected_depth(weights, t)), (samples,))

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        tiles = [rays[k : k + self.tile] for k in range(0, len(rays), self.tile)]
        return Rendering.cat([self._tile(tile, hidden=False).rendering for tile in tiles])

    def cube(self, points: Tensor) -> Tensor:
        """Map world points (P, 3) to the cube [−1, 1]³ of the volume; points outside the box lie outside."""
        return self.box.cube(self.space.points(points.to(self.device, torch.float32)))

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the template's colours (P, K, 3), which are the same in all directions."""
        return self.volume.at(self.cube(points))[1].clamp(0, 1)[:, None].expand(-1, len(directions), -1)

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        """Return the opacity that a ray gains per unit of length: of the world, or of the box in NDC and contracted."""
        u = self.cube(points)
        inside = (u.abs() <= 1).all(-1)
        unit = self.box.half * (self.space.extent if self.space.kind == "world" else 1)
        return torch.where(inside, self.volume.at(u)[0] / unit, 0)

    # ---- state ----------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy.net = copy.shown = deepcopy(self.shown)
        return copy

    def parameters(self) -> list[Tensor]:
        return list(self.net.parameters())

    def state(self) -> dict[str, Tensor]:
        parts = {"net": self.net, "shown": self.shown}
        state = {f"{part}.{name}": value for part, net in parts.items() for name, value in net.state_dict().items()}
        return state | adam_state(self.optimizer) | {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        for part, net in (("net", self.net), ("shown", self.shown)):
            net.load_state_dict({name: state[f"{part}.{name}"] for name in net.state_dict()})
        load_adam(self.optimizer, self.parameters(), state)
        self.generator.set_state(state["generator"].cpu())
        self._volume = None


def looked_up(volume: Volume, march: March) -> tuple[Tensor, Tensor]:
    """Return V_α δ (R, S) and the colours (R, S, 3) of the samples; 0 where there is none.

    A first pass without gradients finds the samples that can count: those that the warp leaves in the template, and
    that no opacity of 1 hides. All others have the weight 0 and the gradient 0, whatever the volume holds there.
    """
    template, real = volume.template, march.real
    with torch.no_grad():
        moved = volume.moved(march.u)
        reach = 1 + 2 / (template.shape[-1] - 1)  # one voxel beyond the template, interpolation reaches 0
        inside = (moved.abs() < reach).all(-1)
        counted = real.masked_scatter(real, inside)
        alpha = sampled(template[:, 3:], moved[inside], "zeros")[:, 0]
        opacity = torch.zeros_like(march.length).masked_scatter(counted, alpha) * march.length
        counted &= add_up(opacity)[0] > 0
    return laid_out(march, counted, *volume.at(march.u[counted[real]]))


def laid_out(march: March, where: Tensor, alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    """Put opacities V_α (P,), times the samples' lengths, and colours (P, 3) into (R, S) and (R, S, 3); 0 elsewhere."""
    opacity = torch.zeros_like(march.length).masked_scatter(where, alpha) * march.length
    return opacity, rgb.new_zeros(*where.shape, 3).masked_scatter(where[..., None], rgb)


class Net(nn.Module):
    """All that is learnt: the latent code, and the decoders of the template and of the warp."""

    def __init__(self, config: NeuralVolumesConfig) -> None:
        super().__init__()
        self.latent = nn.Parameter(torch.zeros(config.latent))
        self.decoder = Decoder(config.latent, config.width, config.template)
        self.warp = None
        if config.warp == "affine":
            self.warp = AffineWarp(config.latent, config.warps, config.warp_cells)
        elif config.warp == "field":
            self.warp = FieldWarp(config.latent, config.width, config.warp_cells)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the latent code from the standard normal distribution, the paper's prior, and the weights."""
        with torch.no_grad():
            self.latent.normal_(generator=generator)
        self.decoder.initialise(generator)
        if self.warp is not None:
            self.warp.initialise(generator)

    def chains(self, yield_callback: Callable[[], None]) -> list[Chain]:
        """Decode the template and, if there is one, the warp, so that gradients can be computed."""
        halves = [self.decoder] if self.warp is None else [self.decoder, self.warp]
        return [Chain(self.latent, half.parts(), yield_callback) for half in halves]

    def volume(self) -> Volume:
        """Decode at once."""
        warp = None if self.warp is None else applied(self.warp.parts(), self.latent)
        return Volume(applied(self.decoder.parts(), self.latent), warp)
