"""The paper's NeRF: two networks, stratified then importance sampling (Mildenhall et al. 2020, arXiv:2003.08934)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.rays import Rays, Rendering, Samples, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw
from nerf_core.methods.mlp.model import MlpModel, Parametrised
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.volume.compositing import absorb, composite, expected_depth
from nerf_core.volume.sampling import inverse_transform, spaced, stratified

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


class NerfModel(MlpModel):
    """The published method. On a CPU its matrix products run in bfloat16 if that is fast there."""

    coarse: ClassVar[str] = "coarse network"
    alone: ClassVar[bool] = False

    config: NerfConfig

    def __init__(self, scene: Scene, config: NerfConfig, device: torch.device, seed: int) -> None:
        names = ("coarse", "fine") if config.fine_samples else ("coarse",)
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

    def coarse_u(self, p: Parametrised, random: bool) -> Tensor:
        """Return the parameters u (R, N_c) of the coarse samples: evenly spaced, or each at random in its bin."""
        u = spaced(p.near, p.far, self.config.coarse_samples, self.disparity and self.ndc is None, self.near)
        return stratified(u, self.generator) if random else u

    def _fine_u(self, coarse_u: Tensor, weights: Tensor, random: bool) -> Tensor:
        """Merge and sort the coarse depths and N_f draws from their weights (without the end bins, as in the code)."""
        middle = (coarse_u[:, 1:] + coarse_u[:, :-1]) / 2
        draws = inverse_transform(
            middle, weights[:, 1:-1], self.config.fine_samples, self.generator if random else None
        )
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

    def _composite(self, name: str, p: Parametrised, u: Tensor, raw: Tensor, rgb: Tensor, noise: bool) -> _Pass:
        steps = u[:, 1:] - u[:, :-1]
        last = torch.full_like(u[:, :1], self.config.last_delta)
        delta = torch.cat([steps, last], -1) * p.length[:, None]
        raw = raw.view(u.shape)
        if noise and self.config.density_noise > 0:
            raw = raw + self.config.density_noise * torch.randn(
                u.shape, generator=self.generator, device=u.device, dtype=u.dtype
            )
        sigma = torch.relu(raw) * p.exists[:, None]
        return _Pass(name, u, delta, sigma, *absorb(sigma, delta), rgb.view(*u.shape, 3))

    # ---- training -------------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        c = self.config
        return Draw(c.rays, c.one_image, c.precrop if step < c.precrop_steps else 1.0)

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one step: MSE of the coarse colour plus MSE of the fine colour, Adam with an exponential decay."""
        self.begin_step(step, steps)
        scale = 1 / truth.numel()
        error, alive = self._gradients(rays, truth, scale, yield_callback)
        self.optimizer.step()
        for name, living in alive.items():
            self._alive[name] = living / (len(rays) * self._samples(name))
        return float(error * scale)

    def _gradients(
        self, rays: Rays, truth: Tensor, scale: float, yield_callback: Callable[[], None]
    ) -> tuple[Tensor, dict[str, int]]:
        """Add up the gradient over all chunks. Returns the summed squared error and the number of living samples."""
        error = torch.zeros((), device=self.device)
        alive = dict.fromkeys(self.networks, 0)
        for start in range(0, len(rays), self.config.chunk_rays):
            chunk = slice(start, start + self.config.chunk_rays)
            p = self.parametrise(rays[chunk])
            u, weights, squared = self.coarse_u(p, random=True), torch.empty(0), error
            for name in self.networks:
                if name == "fine":
                    u = self._fine_u(u, weights, random=True)
                weights, squared, living = self._supervise(name, p, u, truth[chunk], scale)
                alive[name] += living
                yield_callback()
            error = error + squared  # after the loop, of the last network, which draws the picture
        return error, alive

    def _supervise(
        self, name: str, p: Parametrised, u: Tensor, truth: Tensor, scale: float
    ) -> tuple[Tensor, Tensor, int]:
        """Add one network's gradient of the loss. Returns weights, summed squared error, number of living samples."""
        dense = self._alive[name] >= SPARSE_BELOW
        with torch.set_grad_enabled(dense):
            raw, rgb = self._field(name, p, u)
        leaves = raw.detach().requires_grad_(), rgb.detach().requires_grad_()
        done = self._composite(name, p, u, *leaves, noise=True)
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
        u = self.coarse_u(p, random=False)
        passes: list[_Pass] = []
        for name in self.networks:
            if name == "fine":
                if quality == "coarse":
                    break
                u = self._fine_u(u, passes[-1].weights, random=False)
            passes.append(self._composite(name, p, u, *self._field(name, p, u), noise=False))
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
