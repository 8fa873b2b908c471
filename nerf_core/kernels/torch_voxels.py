"""The voxel grid's maths written plainly: what the fast kernels are held to, and what runs where they cannot.

Rays march together, one step of all of them at a time; the gradient is autograd's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.fields.voxel_grid import BRICK, DENSITY, WIDTH, VoxelGrid
from nerf_core.kernels.voxel_kernels import Adam, March, Traced
from nerf_core.spaces import BoxRays

STOP = 1e-3  # transmittance at which nothing behind can still change an 8-bit pixel by one step
STRAIGHT = 0.25  # of its distance from the centre: so far a contracted ray counts as straight when it leaps


class Packed(NamedTuple):
    """M samples, ray after ray, front to back: their ray (M,), t and width (M,), rows (M, 8) and weights (M, 8)."""

    ray: Tensor
    t: Tensor
    width: Tensor
    rows: Tensor
    weights: Tensor


class _Where(NamedTuple):
    """Position and velocity in cells, and ‖x‖∞, at one t of each ray."""

    position: Tensor
    velocity: Tensor
    norm: Tensor


def _at(grid: VoxelGrid, rays: BoxRays, index: Tensor, t: Tensor) -> _Where:
    """Under contraction x → f x with f = (2 − s) s, s = 1/‖x‖∞; hence dx′ = f d + f′ x with f′ = (2s − 2) s² d‖x‖∞."""
    origin, voxel = (torch.from_numpy(v).to(rays.origins) for v in (grid.origin, grid.voxel))
    d = rays.directions[index]
    x = rays.origins[index] + t[:, None] * d
    norm, axis = x.abs().max(-1)
    velocity = d
    if grid.contracted:
        s = 1 / norm.clamp(min=1)
        along = d.gather(1, axis[:, None])[:, 0] * x.gather(1, axis[:, None])[:, 0].sign()
        f, slope = (2 - s) * s, (2 * s - 2) * s * s * along
        outside = (norm > 1)[:, None]
        velocity = torch.where(outside, d * f[:, None] + x * slope[:, None], d)
        x = torch.where(outside, x * f[:, None], x)
    return _Where((x - origin) / voxel, velocity / voxel, norm)


def march(grid: VoxelGrid, rays: BoxRays, step: float, offsets: Tensor) -> Packed:
    """Samples `step` cells apart in the occupied cells; empty blocks are leapt over."""
    voxel, size = torch.from_numpy(grid.voxel).to(rays.origins), torch.tensor(grid.size, device=rays.origins.device)
    everyone = torch.arange(len(rays), device=rays.origins.device)
    straight = step / (rays.directions / voxel).norm(dim=-1)
    t, last = rays.near.clone(), rays.far.clone()
    if not grid.contracted:
        start = _at(grid, rays, everyone, torch.zeros_like(t)).position
        speed = rays.directions / voxel
        crossing = torch.stack([-start / speed, (size - start) / speed])  # ±∞, or NaN on the border, where parallel
        parallel = speed == 0
        low = torch.where(parallel, -torch.inf, crossing.amin(0)).amax(-1)
        high = torch.where(parallel, torch.inf, crossing.amax(0)).amin(-1)
        beside = (parallel & ((start < 0) | (start > size))).any(-1)
        t, last = torch.maximum(t, low), torch.where(beside, -torch.inf, torch.minimum(last, high))
    t = t + offsets * straight
    found: list[tuple[Tensor, ...]] = []
    alive = everyone
    while True:
        alive = alive[t[alive] < last[alive]]
        if not len(alive):
            break
        here = _at(grid, rays, alive, t[alive])
        dt = step / here.velocity.norm(dim=-1)
        cell = here.position.long()
        inside = ((cell >= 0) & (cell < size)).all(-1)
        cell = torch.where(inside[:, None], cell, 0)
        block = cell // BRICK
        leap = grid.leap[tuple(block.unbind(-1))].long()
        leap = torch.where(inside, leap, 0)
        lower = BRICK * (block - (leap - 1)[:, None])
        upper = lower + BRICK * (2 * leap - 1)[:, None]
        gap = torch.maximum((lower - here.position) / here.velocity, (upper - here.position) / here.velocity)
        gap = torch.where(here.velocity == 0, torch.inf, gap).amin(-1)
        if grid.contracted:
            gap = torch.where(here.norm > 1, gap.minimum(STRAIGHT * here.norm), gap)
        steps = torch.where(leap > 0, (gap / dt).floor().clamp(min=0) + 1, 1.0)
        sampled = inside & (leap == 0) & grid.occupied[tuple(cell.unbind(-1))]
        found.append((alive[sampled], t[alive][sampled], dt[sampled], cell[sampled], (here.position - cell)[sampled]))
        t[alive] = t[alive] + steps * dt
    if not found:
        found.append((everyone[:0], t[:0], t[:0], everyone.new_zeros(0, 3), t.new_zeros(0, 3)))
    ray, t, width, cell, within = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = ray.argsort(stable=True)
    ray, t, width, cell, within = (v[order] for v in (ray, t, width, cell, within))
    corners = torch.cartesian_prod(*[torch.arange(2, device=ray.device)] * 3)
    rows = grid.row_of((cell[:, None] + corners).reshape(-1, 3)).view(-1, 8)
    weights = torch.where(corners == 1, within[:, None], 1 - within[:, None]).prod(-1)
    return Packed(ray, t, width, rows, weights)


class Composited(NamedTuple):
    pixel: Tensor  # (R, 5)
    used: Tensor  # (M,) bool: samples before the light was gone
    raw: Tensor
    alpha: Tensor
    light: Tensor
    rgb: Tensor


def composite(rows: Tensor, packed: Packed, views: Tensor, step: float, bias: float, background: Tensor) -> Composited:
    """NeRF Eq. 3 over packed samples; `rows` (M, 16) are the grid's."""
    values = (packed.weights[..., None] * rows[packed.rows]).sum(1)
    raw = values[:, DENSITY] + bias
    d = views[packed.ray]
    basis = torch.stack([torch.full_like(raw, 0.28209479), *(0.48860251 * d[:, a] for a in (1, 2, 0))], -1)
    rgb = torch.sigmoid((values[:, :DENSITY].view(-1, 3, 4) * basis[:, None]).sum(-1))
    tau = (functional.softplus(raw) * step).double()  # sums over all rays' samples, taken apart again: in 64 bits
    total = tau.cumsum(0)
    begins = torch.cat([torch.ones_like(packed.ray[:1], dtype=torch.bool), packed.ray[1:] != packed.ray[:-1]])
    first = (
        torch.where(begins, torch.arange(len(tau), device=tau.device), 0).cummax(0).values if len(tau) else packed.ray
    )
    before = (total - tau) - (total - tau)[first]
    used = torch.exp(-before) >= STOP
    tau = torch.where(used, tau, 0)
    alpha, light = -torch.expm1(-tau).float(), torch.exp(-before).float()
    w = torch.where(used, alpha * light, 0)
    count = len(views)
    color = torch.zeros(count, 3, device=w.device).index_add(0, packed.ray, w[:, None] * rgb)
    far = torch.zeros(count, device=w.device).index_add(0, packed.ray, w * packed.t)
    left = torch.exp(-torch.zeros(count, dtype=torch.float64, device=w.device).index_add(0, packed.ray, tau)).float()
    pixel = torch.cat([color + left[:, None] * background, (1 - left)[:, None], far[:, None]], -1)
    return Composited(pixel, used, raw, alpha, light, rgb)


class TorchVoxels:
    """`VoxelKernels` in torch operations, on any device."""

    name = "torch"

    def __init__(self) -> None:
        self._of: Tensor | None = None  # the rows that the tensors below fit
        self._gradient = self._touched = self._visible = torch.empty(0)

    def _fit(self, grid: VoxelGrid) -> None:
        if self._of is not grid.rows:
            self._of = grid.rows
            self._gradient = torch.zeros_like(grid.rows)
            self._touched, self._visible = (
                torch.zeros(len(grid.rows), dtype=torch.bool, device=grid.rows.device) for _ in range(2)
            )

    def _composited(self, rows: Tensor, grid: VoxelGrid, rays: BoxRays, how: March) -> tuple[Packed, Composited]:
        packed = march(grid, rays, how.step, how.offsets)
        return packed, composite(rows, packed, rays.views, how.step, how.bias, how.background)

    @torch.no_grad()
    def render(self, grid: VoxelGrid, rays: BoxRays, march: March) -> Tensor:
        return self._composited(grid.rows, grid, rays, march)[1].pixel

    @torch.no_grad()
    def trace(self, grid: VoxelGrid, rays: BoxRays, march: March) -> list[Traced]:
        packed, done = self._composited(grid.rows, grid, rays, march)
        found = []
        for r in range(len(rays)):
            i = ((packed.ray == r) & done.used).nonzero()[:, 0]
            parts = (packed.t, packed.width, done.raw, done.alpha, done.light, done.rgb)
            found.append(Traced(*(v[i].cpu() for v in parts), pixel=done.pixel[r].cpu()))
        return found

    def accumulate(self, grid: VoxelGrid, rays: BoxRays, truth: Tensor, march: March) -> tuple[float, int]:
        self._fit(grid)
        rows = grid.rows.detach().requires_grad_()
        packed, done = self._composited(rows, grid, rays, march)
        squared = (done.pixel[:, :3] - truth).square().sum()
        corner = packed.rows[done.used]
        raw = rows[corner, DENSITY]
        rough = (raw - raw.mean(1, keepdim=True)).square().sum()
        (gradient,) = torch.autograd.grad(squared / 2 + march.smoothness * rough / 2, rows)
        self._gradient += gradient
        self._touched[corner.flatten()] = True
        weight = (done.alpha * done.light)[done.used]
        self._visible[corner[weight > march.threshold, 0]] = True
        return float(squared.detach()), int(done.used.sum())

    def forget(self) -> None:
        self._gradient.zero_()
        self._touched.zero_()

    def gradient(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return self._gradient.clone()

    def seen(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return self._visible.clone()

    def see(self, grid: VoxelGrid, seen: Tensor) -> None:
        self._fit(grid)
        self._visible.copy_(seen)

    def update(self, grid: VoxelGrid, moments: Tensor, adam: Adam) -> None:
        self._fit(grid)
        i = self._touched.nonzero()[:, 0]
        p, m, g = grid.rows[i], moments[i], self._gradient[i]
        new = torch.zeros_like(m)
        new[:, :13] = adam.keep * m[:, :13] + (1 - adam.keep) * g[:, :13]
        new[:, 14] = adam.keep_square * m[:, 14] + (1 - adam.keep_square) * g[:, :12].square().mean(-1)
        new[:, 15] = adam.keep_square * m[:, 15] + (1 - adam.keep_square) * g[:, 12].square()
        rates = torch.zeros(len(i), WIDTH, device=p.device)
        rates[:, :12], rates[:, DENSITY] = adam.rate_color, adam.rate_density
        square = torch.where(torch.arange(WIDTH, device=p.device) < DENSITY, new[:, 14:15], new[:, 15:16])
        grid.rows[i] = p - rates * adam.warm * new / ((square * adam.warm_square).sqrt() + adam.epsilon)
        moments[i] = new
        self.forget()
