"""Multiplane images of several reference views, optimised on the photos and blended in each pixel.

LLFF (Mildenhall et al. 2019, arXiv:1905.00889) lets a network predict an MPI for each photo. Its trained weights are
not available here: a plane sweep makes a first guess of a few MPIs, and gradient descent fits them to the photos. A
pixel is blended as in LLFF, section 4.2: with the colour C_k and the accumulated opacity A_k of view k's MPI along the
ray and the weight β_k of the view,

    C = Σ_k β_k C_k / Σ_k β_k A_k,    where C_k = Σ_i w_{k,i} c_{k,i} is not divided by A_k.

So what one MPI does not hold, because its view did not see it, is filled in by the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from pathlib import PurePosixPath
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.language import marked, phrase
from nerf_core.common.text import size
from nerf_core.geometry.rays import Rays, Rendering, Trace
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Defaults, Draw
from nerf_core.methods.mpi.config import MpiConfig
from nerf_core.methods.mpi.optimizer import Gradient, Planes, descend
from nerf_core.methods.mpi.planes import Crossings, Seen, Stack, alpha_gradient, look
from nerf_core.methods.mpi.references import blending, spread_out
from nerf_core.methods.mpi.sweep import sweep
from nerf_core.methods.mpi.tracing import plane_samples
from nerf_core.volume.compositing import expected_depth

COVERED = 1 / 16  # accumulated opacity below which a pixel fades to the background, instead of showing noise as colour
PIECE = 4096  # rays of a step between two calls of the yield callback: each sees one MPI, about 10 ms on a CPU
TILE = 2048  # rays of a picture that are drawn at once on a CPU: each sees several MPIs, about 15 ms
TILE_GPU = 1 << 16  # the same on a GPU: enough to keep it busy, about 200 MB for each MPI
MEASURED = 1024  # rays of a step whose blended colour is compared with the photo, for the error that is reported


class Blend(NamedTuple):
    """What R rays see of several MPIs.

    views: the MPIs that at least one ray blends.
    shares: (V, R) the weight β_k / max(Σ β A, COVERED) of each of them.
    seen: what the rays see of each.
    crossings: where they cross its planes.
    color, opacity: (3, R) and (R,), not over the background.
    """

    views: list[int]
    shares: Tensor
    seen: list[Seen]
    crossings: list[Crossings]
    color: Tensor
    opacity: Tensor


class MpiModel(Defaults):
    """Optimised MPIs with their optimiser; see the module."""

    def __init__(self, scene: Scene, config: MpiConfig, device: torch.device, seed: int) -> None:
        self.config, self.device, self.scene = config, device, scene
        self.background = torch.tensor(scene.background, device=device)
        self.generator = torch.Generator().manual_seed(seed)
        self.generators = (self.generator,)
        self.tile = TILE if device.type == "cpu" else TILE_GPU
        self.views = scene.trained(config.train_images)
        cameras = [scene.views[view].camera for view in self.views]
        places = np.stack([camera.c2w[:, 3] for camera in cameras])
        bounds = scene.near, scene.far
        self.stacks = [
            Stack.of(self.views[i], cameras[i], bounds, config.planes, config.resolution, config.margin, device)
            for i in spread_out(places, config.references)
        ]
        self.positions = torch.stack([stack.position for stack in self.stacks])
        # LLFF's γ = f / (D z_0): the disparity of the nearest content, in planes per unit of length
        first = self.stacks[0]
        self.falloff = config.falloff * float(first.focal.mean()) / (config.planes * scene.near)
        self.swept = 0  # MPIs that are filled
        pictures = -(-config.planes // config.shared)
        self.planes = [Planes.zeros(stack, pictures) for stack in self.stacks]
        self.updates = [0] * len(self.stacks)  # of Adam
        self._spare: Planes | None = None  # where the next update goes; the planes that it replaces are spare then
        self._lent: set[int] = set()  # MPIs whose planes a frozen copy shows too

    @property
    def stage(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  only read
        count = len(self.stacks)
        if self.swept < count:
            return phrase("plane sweep: {swept} of {count} MPIs filled", swept=self.swept, count=count)
        planes = sum(4 * value.numel() for value in self.parameters())
        optimiser = 2 * planes + 3 * planes // count  # two moments, and a spare MPI with its own
        return phrase(
            "{count} MPIs of {planes} planes: {size}, and {optimiser} to train them",
            count=count,
            planes=self.config.planes,
            size=size(planes),
            optimiser=size(optimiser),
        )

    # ---- rendering ------------------------------------------------------------------------------------------------

    def weights(self, origins: Tensor) -> Tensor:
        """Return the blending weights β (R, K) of the MPIs for rays from origins (R, 3); 0 of those not yet filled."""
        ready = self.positions[: max(1, self.swept)]
        distances = (origins.double()[:, None] - ready).norm(dim=-1)
        weights = blending(distances, self.config.blended, self.falloff)
        return torch.nn.functional.pad(weights, (0, len(self.stacks) - len(ready))).float()

    def look(self, k: int, crossings: Crossings) -> Seen:
        """Return what rays see of MPI k alone."""
        return look(self.planes[k].alpha, self.planes[k].color, crossings.at)

    def blend(self, rays: Rays) -> Blend:
        """Return what rays see of their nearest MPIs, blended as the module says."""
        weights = self.weights(rays.origins).T
        views = (weights > 0).any(1).nonzero()[:, 0].tolist()
        crossings = [self.stacks[k].crossings(rays) for k in views]
        seen = [self.look(k, crossed) for k, crossed in zip(views, crossings, strict=True)]
        beta = weights[views]
        covered = (beta * torch.stack([s.opacity for s in seen])).sum(0)
        shares = beta / covered.clamp(min=COVERED)
        color = (shares[:, None] * torch.stack([s.color for s in seen])).sum(0)
        return Blend(views, shares, seen, crossings, color, covered / covered.clamp(min=COVERED))

    def rendered(self, blend: Blend) -> Rendering:
        """Return the pixels of blended rays: over the background, with the expected depth."""
        color = (blend.color + (1 - blend.opacity) * self.background[:, None]).T
        weights = torch.cat([share * s.weights for share, s in zip(blend.shares, blend.seen, strict=True)])
        t = torch.cat([crossed.t for crossed in blend.crossings])
        depth = expected_depth(weights.T.contiguous(), torch.where(weights > 0, t, 0).T.contiguous())
        return Rendering(color, blend.opacity, depth)

    @torch.no_grad()
    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        rays = rays.to(self.device)
        return Rendering.cat(
            [self.rendered(self.blend(rays[i : i + self.tile])) for i in range(0, len(rays), self.tile)]
        )

    @torch.no_grad()
    def trace(self, rays: Rays) -> Trace:
        """Open the pixels of rays: the planes of each blended MPI, and all of them in one line, which is the pixel."""
        if len(rays) > self.tile:
            raise ValueError(f"trace opens at most {self.tile} rays at a time, got {len(rays)}")
        rays = rays.to(self.device)
        blend = self.blend(rays)
        passes, merged = [], []
        for k, share, seen, crossed in zip(blend.views, blend.shares, blend.seen, blend.crossings, strict=True):
            rgb = seen.colors()
            real = self.stacks[k].covers(crossed.at) & (share > 0)
            passes.append(plane_samples(self.name(k), self.scene.ndc, rays, crossed.t, seen.weights, rgb, real))
            merged.append((crossed.t, share * seen.weights, rgb, real))
        every = (torch.cat(values) for values in zip(*merged, strict=True))
        passes.append(plane_samples(marked("planes"), self.scene.ndc, rays, *every))
        return Trace(self.rendered(blend), tuple(passes))

    def name(self, k: int) -> str:
        """Return the name of an MPI: that of its reference view's file."""
        return phrase("view {name}", name=PurePosixPath(self.scene.views[self.stacks[k].view].name).stem)

    # ---- training -------------------------------------------------------------------------------------------------

    def draw(self, step: int) -> Draw:
        return Draw(self.config.rays, one_image=True)

    @torch.no_grad()
    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Fill one more MPI, or improve one of those that the rays blend.

        The MPI of a step is drawn with the blending weights as probabilities.
        """
        rays, truth = rays.to(self.device), truth.to(self.device)
        if self.swept < len(self.stacks):
            return self._sweep(rays, truth, yield_callback)
        chosen = self.weights(rays.origins.double().mean(0, keepdim=True).float())[0].cpu()
        k = int(torch.multinomial(chosen, 1, generator=self.generator))
        rays, truth = self._sorted(k, rays, truth)
        behind = torch.rand(3, 1, generator=self.generator).to(self.device)
        done: list[tuple[Tensor, ...]] = []
        for start in range(0, len(rays), PIECE):
            crossed = self.stacks[k].crossings(rays[start : start + PIECE])
            seen = self.look(k, crossed)
            gradient = 2 * (seen.color + (1 - seen.opacity) * behind - truth[start : start + PIECE].T)
            done.append((crossed.at, alpha_gradient(seen, gradient, behind), seen.weights, gradient))
            yield_callback()
        error = self._error(rays, truth)
        yield_callback()
        found = Gradient(*(torch.cat(values, 1) for values in zip(*done, strict=True)))
        self._update(k, found, self._rate(step, steps), yield_callback)
        return error

    def _rate(self, step: int, steps: int | None) -> float:
        """Return the share of the learning rates at a step: 1 at first, `decay` at the end of the run and after it."""
        return self.config.decay ** min(1.0, step / (steps or self.config.total_steps))

    def _error(self, rays: Rays, truth: Tensor) -> float:
        """Return the mean squared error of the blended colour, of MEASURED rays at most."""
        some = slice(None, None, -(-len(rays) // MEASURED))
        return float((self.render(rays[some]).color - truth[some]).square().mean())

    def _sweep(self, rays: Rays, truth: Tensor, yield_callback: Callable[[], None]) -> float:
        k, c = self.swept, self.config
        stack = self.stacks[k]
        others = self._by_distance(stack)[: c.sweep_views]
        alpha, color = sweep(
            self.scene, others, stack, len(self.planes[k].color), c.sweep_window, c.sweep_softness, yield_callback
        )
        self.planes[k] = self.planes[k]._replace(alpha=alpha, color=color)
        self._lent.discard(k)
        self.swept += 1
        return self._error(rays, truth)

    def _by_distance(self, stack: Stack) -> list[int]:
        """Return the training views, the nearest to a reference view first."""
        place = stack.position.cpu().numpy()
        return sorted(self.views, key=lambda v: float(np.linalg.norm(self.scene.views[v].camera.c2w[:, 3] - place)))

    def _sorted(self, k: int, rays: Rays, truth: Tensor) -> tuple[Rays, Tensor]:
        """Sort rays by where they cross MPI k, row by row, so that neighbours in memory are visited together."""
        at = self.stacks[k].crossings(rays).at[len(self.stacks[k].depths) // 2]
        order = (at[:, 1].floor() * (self.stacks[k].width + 64) + at[:, 0]).argsort(stable=True)
        return rays[order], truth[order]

    def _update(self, k: int, found: Gradient, rate: float, yield_callback: Callable[[], None]) -> None:
        """Make an optimiser step on MPI k. Its new planes replace the old ones at the end, when nothing can fail."""
        old, new = self.planes[k], self._spare
        if new is None or new.alpha.shape != old.alpha.shape:
            new = Planes(*(torch.empty_like(value) for value in old))
        self._spare = new
        descend(old, new, self.stacks[k], found, self.config, self.updates[k] + 1, rate, yield_callback)
        self.updates[k] += 1
        self.planes[k], self._spare = new, None if k in self._lent else old
        self._lent.discard(k)

    # ---- state ----------------------------------------------------------------------------------------------------

    def frozen(self) -> Self:
        other = copy(self)
        other.planes, other._spare = list(self.planes), None
        self._lent = set(range(len(self.stacks)))
        return other

    def parameters(self) -> list[Tensor]:
        return [value for planes in self.planes for value in (planes.alpha, planes.color)]

    def state(self) -> dict[str, Tensor]:
        state = {f"planes.{k}.{name}": value for k, planes in enumerate(self.planes)
                 for name, value in planes._asdict().items()}  # fmt: skip
        counts = {"swept": torch.tensor(self.swept), "updates": torch.tensor(self.updates)}
        return state | counts | {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Nothing changes if it does not fit."""
        swept, updates = int(state["swept"]), [int(count) for count in state["updates"]]
        if not 0 <= swept <= len(self.stacks) or len(updates) != len(self.stacks) or min(updates) < 0:
            raise ValueError(f"{swept} of {len(self.stacks)} MPIs filled, updates {updates}")
        planes = [
            Planes(*(_fitting(state[f"planes.{k}.{name}"], value) for name, value in own._asdict().items()))
            for k, own in enumerate(self.planes)
        ]
        self.generator.set_state(state["generator"].cpu())
        self.planes, self.swept, self.updates = planes, swept, updates
        self._lent = set()


def _fitting(value: Tensor, like: Tensor) -> Tensor:
    """Return a copy of a stored tensor on the device of `like`. Raises ValueError if it has another shape or type."""
    if (value.shape, value.dtype) != (like.shape, like.dtype):
        raise ValueError(f"planes of {tuple(value.shape)} {value.dtype}, not {tuple(like.shape)} {like.dtype}")
    return torch.empty_like(like).copy_(value)
