"""How rays find their samples, written plainly: all rays take a step at a time.

What `nerf_core.kernels.numba_march` is held to, and what runs where it cannot.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.cells import BLOCK, Cells

STEPPED = 2**-22  # of t: two of float32's; a shorter step might leave t where it is, and the march would never end
STRAIGHT = 0.1  # of its distance from the centre: so far a contracted ray counts as straight when it leaps
NEARING = 0.25  # of the same: the longest step of one that comes nearer; far outside one step would cross the scene


class Marched(NamedTuple):
    """M samples, ray after ray, front to back: their ray (M,), t and width (M,), cell (M, 3), place in it (M, 3)."""

    ray: Tensor
    t: Tensor
    width: Tensor
    cell: Tensor
    within: Tensor


class _Where(NamedTuple):
    """Position and velocity in cells, ‖x‖∞, and whether that shrinks, at one t of each ray."""

    position: Tensor
    velocity: Tensor
    norm: Tensor
    nearing: Tensor


def _at(cells: Cells, rays: BoxRays, index: Tensor, t: Tensor) -> _Where:
    """Under contraction x → f x with f = (2 − s) s, s = 1/‖x‖∞; hence dx′ = f d + f′ x with f′ = (2s − 2) s² d‖x‖∞."""
    origin, voxel = (torch.from_numpy(v).to(rays.origins) for v in (cells.origin, cells.voxel))
    d = rays.directions[index]
    x = rays.origins[index] + t[:, None] * d
    norm, axis = x.abs().max(-1)
    along = d.gather(1, axis[:, None])[:, 0] * x.gather(1, axis[:, None])[:, 0].sign()
    velocity = d
    if cells.contracted:
        s = 1 / norm.clamp(min=1)
        f, slope = (2 - s) * s, (2 * s - 2) * s * s * along
        outside = (norm > 1)[:, None]
        velocity = torch.where(outside, d * f[:, None] + x * slope[:, None], d)
        x = torch.where(outside, x * f[:, None], x)
    return _Where((x - origin) / voxel, velocity / voxel, norm, along < 0)


def march(cells: Cells, rays: BoxRays, step: float, offsets: Tensor) -> Marched:
    """Samples `step` cells apart in the occupied cells; empty blocks are leapt over."""
    voxel, size = torch.from_numpy(cells.voxel).to(rays.origins), torch.tensor(cells.size, device=rays.origins.device)
    everyone = torch.arange(len(rays), device=rays.origins.device)
    straight = step / (rays.directions / voxel).norm(dim=-1)
    t, last = rays.near.clone(), rays.far.clone()
    if not cells.contracted:
        start = _at(cells, rays, everyone, torch.zeros_like(t)).position
        speed = rays.directions / voxel
        crossing = torch.stack([-start / speed, (size - start) / speed])  # ±∞, or NaN on the border, where parallel
        parallel = speed == 0
        low = torch.where(parallel, -torch.inf, crossing.amin(0)).amax(-1)
        high = torch.where(parallel, torch.inf, crossing.amax(0)).amin(-1)
        beside = (parallel & ((start < 0) | (start > size))).any(-1)
        t, last = torch.maximum(t, low), torch.where(beside, -torch.inf, torch.minimum(last, high))
    t = t + offsets * straight
    found: list[tuple[Tensor, ...]] = []
    alive = everyone[(straight > 0) & rays.origins.isfinite().all(-1)]  # else something in it is no number
    while True:
        alive = alive[t[alive] < last[alive]]
        if not len(alive):
            break
        here = _at(cells, rays, alive, t[alive])
        dt = step / here.velocity.norm(dim=-1)
        away = here.norm / rays.directions[alive].norm(dim=-1)  # from the centre, in t
        if cells.contracted:
            dt = torch.where((here.norm > 1) & here.nearing, dt.minimum(NEARING * away), dt)
        dt = dt.maximum(t[alive] * STEPPED)
        inside = ((here.position >= 0) & (here.position < size)).all(-1)
        cell = torch.where(inside[:, None], here.position, 0.0).long()
        block = cell // BLOCK
        leap = cells.leap[tuple(block.unbind(-1))].long()
        leap = torch.where(inside, leap, 0)
        lower = BLOCK * (block - (leap - 1)[:, None])
        upper = lower + BLOCK * (2 * leap - 1)[:, None]
        gap = torch.maximum((lower - here.position) / here.velocity, (upper - here.position) / here.velocity)
        gap = torch.where(here.velocity == 0, torch.inf, gap).amin(-1)
        if cells.contracted:
            gap = torch.where(here.norm > 1, gap.minimum(STRAIGHT * away), gap)
        steps = torch.where(leap > 0, (gap / dt).floor().clamp(min=0) + 1, 1.0)
        sampled = inside & (leap == 0) & cells.occupied[tuple(cell.unbind(-1))]
        found.append((alive[sampled], t[alive][sampled], dt[sampled], cell[sampled], (here.position - cell)[sampled]))
        t[alive] = t[alive] + steps * dt
    if not found:
        found.append((everyone[:0], t[:0], t[:0], everyone.new_zeros(0, 3), t.new_zeros(0, 3)))
    ray, t, width, cell, within = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = ray.argsort(stable=True)
    ray, t, width, cell, within = (v[order] for v in (ray, t, width, cell, within))
    return Marched(ray, t, width, cell, within)
