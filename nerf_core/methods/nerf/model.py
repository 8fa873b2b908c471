"""The paper's NeRF: two networks, stratified then importance sampling (Mildenhall et al. 2020, arXiv:2003.08934)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw
from nerf_core.methods.mlp.model import MlpModel, Parametrised
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.volume.compositing import absorb, composite, expected_depth
from nerf_core.volume.sampling import inverse_transform, quantiles, spaced, within_bins

# Samples of density 0 have no gradient, because of the ReLU; the others are called alive. If less than this share f is
# alive, it is cheaper to evaluate all samples without a graph and the living ones again with one than to make one dense
# pass (a backward pass costs two forward passes, hence 1 + 3f < 3).
SPARSE_BELOW = 0.6
# The number of living samples is rounded up to a multiple of this, because oneDNN compiles a kernel for every new
# number of rows, which takes longer than running it.
BLOCK = 256
TILE_PRODUCTS = 2.5e9  # multiplications of one tile on a CPU: about 10 ms on two cores that are fast at bfloat16


class _Pass(NamedTuple):
    """One network along R rays: the parameters u of its samples, and what was composited."""

    name: str
    u: Tensor
    delta: Tensor
    sigma: Tensor
    alpha: Tensor
    transmittance: Tensor
    weights: Tensor
    rgb: Tensor


class _Random(NamedTuple):
    """The random numbers of R rays in training. They do not depend on the networks, so they are drawn beforehand.

    strata: (R, N_c) uniform, places in the coarse bins. levels: (R, N_f) uniform, levels of the CDF.
    noise: normal numbers for the density of every sample, by network; empty if the density has no noise.
    """

    strata: Tensor
    levels: Tensor
    noise: dict[str, Tensor]

    def of(self, rays: slice) -> _Random:
        return _Random(self.strata[rays], self.levels[rays], {name: v[rays] for name, v in self.noise.items()})


class NerfModel(MlpModel):
    """The published method. On a CPU its matrix products run in bfloat16 if that is fast there."""

    coarse: ClassVar[str] = marked("coarse network")
    alone: ClassVar[bool] = False

    config: NerfConfig

    def __init__(self, scene: Scene, config: NerfConfig, device: torch.device, seed: int) -> None:
        names = (marked("coarse"), marked("fine")) if config.fine_samples else (marked("coarse"),)
        super().__init__(scene, config, device, torch.Generator(device).manual_seed(seed), names)
        self.disparity, self.near = scene.disparity, scene.near
        self.tile = config.tile or self._fitting_tile()
        self._alive = dict.fromkeys(self.networks, 1.0)

    def _fitting_tile(self) -> int:
        """The number of rays whose matrix products are large enough to be efficient and small enough to end soon."""
        if self.device.type != "cpu":
            return 4096
        # a sample takes about as many multiplications as the network has weights
        ray = sum(self._samples(name) * sum(p.numel() for p in net.parameters()) for name, net in self.networks.items())
        return 2 ** int(min(max(math.log2(TILE_PRODUCTS / ray), 3), 9))

    # ---- sampling -------------------------------------------------------------------------------------------------

    def _random(self, rays: int) -> _Random:
        """Draw the numbers of so many rays, in the order in which the networks take them."""
        c, like = self.config, {"generator": self.generator, "device": self.device}
        strata, noise = torch.rand(rays, c.coarse_samples, **like), dict[str, Tensor]()
        levels = strata[:, :0]
        for name in self.networks:
            if name == "fine":
                levels = torch.rand(rays, c.fine_samples, **like)
            if c.density_noise > 0:
                noise[name] = torch.randn(rays, self._samples(name), **like)
        return _Random(strata, levels, noise)

    def coarse_u(self, p: Parametrised) -> Tensor:
        """Return the parameters u (R, N_c) of the coarse samples, evenly spaced."""
        return spaced(p.near, p.far, self.config.coarse_samples, self.disparity and self.ndc is None, self.near)

    def _fine_u(self, coarse_u: Tensor, weights: Tensor, levels: Tensor | None = None) -> Tensor:
        """Merge and sort the coarse depths and N_f draws from their weights (without the end bins, as in the code).

        levels: (R, N_f) of the CDF, random ones; None: evenly spaced ones.
        """
        middle, inner = (coarse_u[:, 1:] + coarse_u[:, :-1]) / 2, weights[:, 1:-1]
        if levels is None:
            draws = inverse_transform(middle, inner, self.config.fine_samples, None)
        else:
            draws = quantiles(middle, inner, levels)
        return torch.cat([coarse_u, draws], -1).sort(-1).values

    # ---- evaluating -----------------------------------------------------------------------------------------------

    def _field(self, name: str, p: Parametrised, u: Tensor, index: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Raw density (P,) and colour (P, 3) at the samples u (R, S), or only at those of the flat `index`."""
        samples = u.shape[1]
        x = (p.origins[:, None] + u[..., None] * p.directions[:, None]).flatten(0, 1)
        if index is None:
            d = p.encoded.repeat_interleave(samples, 0)
        else:
            x, d = x[index], p.encoded[torch.div(index, samples, rounding_mode="floor")]
        return self.networks[name](x, d)

    def _composite(
        self, name: str, p: Parametrised, u: Tensor, raw: Tensor, rgb: Tensor, noise: Tensor | None = None
    ) -> _Pass:
        steps = u[:, 1:] - u[:, :-1]
        last = torch.full_like(u[:, :1], self.config.last_delta)
        delta = torch.cat([steps, last], -1) * p.length[:, None]
        raw = raw.view(u.shape)
        if noise is not None:
            raw = raw + self.config.density_noise * noise
        sigma = torch.relu(raw) * p.exists[:, None]
        return _Pass(name, u, delta, sigma, *absorb(sigma, delta), rgb.view(*u.shape, 3))

    # ---- training -------------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        c = self.config
        return Draw(c.rays * self.group.size, c.one_image, c.precrop if step < c.precrop_steps else 1.0)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: MSE of the coarse colour plus MSE of the fine colour, Adam with an exponential decay."""
        self.begin_step(step, steps)
        batch = len(rays) if self.group.size == 1 else self.draw(step).rays
        scale = 1 / (3 * batch)
        error, alive = self._gradients(rays, truth, batch, scale, yield_callback)
        self.group.add([error, *(p.grad for p in self.parameters() if p.grad is not None)])
        self.group.add([alive])
        self.optimizer.step()
        for name, living in zip(self.networks, alive.tolist(), strict=True):
            self._alive[name] = living / (batch * self._samples(name))
        return float(error * scale)

    def _gradients(
        self, rays: Rays, truth: Tensor, batch: int, scale: float, yield_callback: Callable[[], None]
    ) -> tuple[Tensor, Tensor]:
        """Add up the gradient over all chunks of a batch of which `rays` are this process's part.

        Returns the summed squared error, and the number of living samples (N,) int64 of each of the N networks.
        """
        error = torch.zeros((), device=self.device)
        alive = torch.zeros(len(self.networks), dtype=torch.long)
        own = self.group.part(batch)
        for start in range(0, batch, self.config.chunk_rays):
            count = min(self.config.chunk_rays, batch - start)
            random = self._random(count)
            first, last = max(start, own.start), min(start + count, own.stop)
            if first >= last:  # other processes' rays: their numbers had to be drawn
                continue
            random, chunk = random.of(slice(first - start, last - start)), slice(first - own.start, last - own.start)
            p = self.parametrise(rays[chunk])
            u, weights, squared = within_bins(self.coarse_u(p), random.strata), torch.empty(0), error
            for i, name in enumerate(self.networks):
                if name == "fine":
                    u = self._fine_u(u, weights, random.levels)
                weights, squared, living = self._supervise(name, p, u, truth[chunk], scale, random.noise.get(name))
                alive[i] += living
                yield_callback()
            error = error + squared  # after the loop, of the last network, which draws the picture
        return error, alive

    def _supervise(
        self, name: str, p: Parametrised, u: Tensor, truth: Tensor, scale: float, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, int]:
        """Add one network's gradient of the loss. Returns weights, summed squared error, number of living samples."""
        dense = self._alive[name] >= SPARSE_BELOW
        with torch.set_grad_enabled(dense):
            raw, rgb = self._field(name, p, u)
        leaves = raw.detach().requires_grad_(), rgb.detach().requires_grad_()
        done = self._composite(name, p, u, *leaves, noise)
        color, _ = composite(done.weights, done.rgb, self.background)
        squared = (color - truth).square().sum()
        raw_grad, rgb_grad = torch.autograd.grad(squared * scale, leaves)
        living = ((raw_grad != 0) | (rgb_grad != 0).any(-1)).nonzero().squeeze(-1)
        alive = len(living)
        if not dense and alive:
            living = functional.pad(living, (0, -alive % BLOCK))  # pads with repeated samples that get no gradient
            raw, rgb = self._field(name, p, u, living)
            raw_grad, rgb_grad = raw_grad[living], rgb_grad[living]
            raw_grad[alive:], rgb_grad[alive:] = 0, 0
        if alive:
            torch.autograd.backward([raw, rgb], [raw_grad, rgb_grad])
        return done.weights.detach(), squared.detach(), alive

    def halve(self) -> bool:
        if self.config.chunk_rays == 1:
            return False
        self.config = replace(self.config, chunk_rays=self.config.chunk_rays // 2)
        return True

    def _samples(self, name: str) -> int:
        return self.config.coarse_samples + (self.config.fine_samples if name == "fine" else 0)

    # ---- rendering ------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _tile(self, rays: Rays, quality: str) -> Trace:
        """Evaluate at most `tile` rays, always as a full tile, so that a pixel does not depend on its neighbours."""
        count = len(rays)
        padded = rays.to(self.device).padded(self.tile)
        p = self.parametrise(padded)
        u = self.coarse_u(p)
        passes: list[_Pass] = []
        for name in self.networks:
            if name == "fine":
                if quality == "coarse":
                    break
                u = self._fine_u(u, passes[-1].weights)
            passes.append(self._composite(name, p, u, *self._field(name, p, u)))
        color, opacity = composite(passes[-1].weights, passes[-1].rgb, self.background)
        depth = expected_depth(passes[-1].weights, passes[-1].u)
        if self.ndc is not None:  # the mean is taken in t′, then mapped to the world
            depth = self.ndc.world_t(padded.origins, padded.directions, depth[:, None])[:, 0]
        samples = tuple(self._exported(done, padded, count) for done in passes)
        return Trace(Rendering(color[:count], opacity[:count], depth[:count]), samples)

    def _exported(self, done: _Pass, rays: Rays, count: int) -> Samples:
        t = done.u if self.ndc is None else self.ndc.world_t(rays.origins, rays.directions, done.u)
        return Samples(done.name, *(v[:count] for v in (t, *done[2:])))

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        return Rendering.cat(
            [self._tile(rays[i : i + self.tile], quality).rendering for i in range(0, len(rays), self.tile)]
        )

    def trace(self, rays: Rays) -> Trace:
        if len(rays) > self.tile:
            raise ValueError(f"trace opens at most {self.tile} rays at a time, got {len(rays)}")
        return self._tile(rays, "fine")

    # ---- state ----------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        shares = {f"alive.{name}": torch.tensor(share, dtype=torch.float64) for name, share in self._alive.items()}
        return super().state() | shares

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        shares = {name: float(state[f"alive.{name}"]) for name in self.networks}
        super().load_state(state)
        self._alive = shares
