"""March along rays with torch operations: all rays take one step at a time.

This is the plain reference for `nerf_core.kernels.numba_march`, and the fallback where numba cannot run.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.cells import BLOCK, Cells

STEPPED = 2**-22  # shortest step, relative to t: two float32 spacings. A shorter one might not change t at all.
STRAIGHT = 0.1  # longest leap of a contracted ray, relative to its distance from the centre: it curves
NEARING = 0.25  # longest step towards the centre, relative to the same: far outside one would cross the scene


class Marched(NamedTuple):
    """M samples, ray after ray, front to back.

    ray: (M,). t, width: (M,). cell: (M, 3), counted in cells of its size. within: (M, 3), the position in the cell, in
    [0, 1]. doublings: (M,), the cell's size; see `VoxelGrid`.
    """

    ray: Tensor
    t: Tensor
    width: Tensor
    cell: Tensor
    within: Tensor
    doublings: Tensor


class _Where(NamedTuple):
    """Position and velocity in cells, ‖x‖∞, and whether ‖x‖∞ decreases, at one t of each ray."""

    position: Tensor
    velocity: Tensor
    norm: Tensor
    nearing: Tensor


def _at(cells: Cells, rays: BoxRays, index: Tensor, t: Tensor) -> _Where:
    """Contraction x → f x, f = (2 − s) s, s = 1/‖x‖∞, has the velocity f d + f′ x with f′ = (2s − 2) s² d‖x‖∞/dt."""
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


def _ends(cells: Cells, rays: BoxRays) -> tuple[Tensor, Tensor]:
    """Return where the march of each ray begins and ends, (R,) each. A ray beside the box ends before it begins."""
    if cells.contracted:  # all of space lies in the box
        return rays.near.clone(), rays.far.clone()
    voxel, size = torch.from_numpy(cells.voxel).to(rays.origins), torch.tensor(cells.size, device=rays.origins.device)
    everyone = torch.arange(len(rays), device=rays.origins.device)
    start = _at(cells, rays, everyone, torch.zeros_like(rays.near)).position
    speed = rays.directions / voxel
    crossing = torch.stack([-start / speed, (size - start) / speed])  # ±∞, or NaN on the border, where parallel
    parallel = speed == 0
    low = torch.where(parallel, -torch.inf, crossing.amin(0)).amax(-1)
    high = torch.where(parallel, torch.inf, crossing.amax(0)).amin(-1)
    beside = (parallel & ((start < 0) | (start > size))).any(-1)
    return torch.maximum(rays.near, low), torch.where(beside, -torch.inf, torch.minimum(rays.far, high))


class _Cell(NamedTuple):
    """The cell at one t of each of A rays, and the empty blocks around it.

    cell: (A, 3); 0 outside the box.
    sampled: (A,) whether a sample is placed in it.
    leap: (A,) as `Cells.leap`; 0 outside the box.
    gap: (A,) the length in t up to the end of the empty blocks, if `leap` is not 0.
    """

    cell: Tensor
    sampled: Tensor
    leap: Tensor
    gap: Tensor


def _cell_at(cells: Cells, here: _Where) -> _Cell:
    size = torch.tensor(cells.size, device=here.position.device)
    inside = ((here.position >= 0) & (here.position < size)).all(-1)
    cell = torch.where(inside[:, None], here.position, 0.0).long()
    block = cell // BLOCK
    leap = cells.leap[tuple(block.unbind(-1))].long()
    leap = torch.where(inside, leap, 0)
    lower = BLOCK * (block - (leap - 1)[:, None])
    upper = lower + BLOCK * (2 * leap - 1)[:, None]
    gap = torch.maximum((lower - here.position) / here.velocity, (upper - here.position) / here.velocity)
    gap = torch.where(here.velocity == 0, torch.inf, gap).amin(-1)
    sampled = inside & (leap == 0) & (cells.kinds[tuple(cell.unbind(-1))] > 0)
    return _Cell(cell, sampled, leap, gap)


def march(cells: Cells, rays: BoxRays, step: float, offsets: Tensor) -> Marched:
    """Place samples `step` cells apart in the occupied cells, leaping over empty blocks.

    offsets: (R,), where each ray's first sample lies in its step, 0 … 1.
    """
    everyone = torch.arange(len(rays), device=rays.origins.device)
    straight = step / (rays.directions / torch.from_numpy(cells.voxel).to(rays.origins)).norm(dim=-1)
    t, last = _ends(cells, rays)
    t = t + offsets * straight
    found: list[tuple[Tensor, ...]] = []
    alive = everyone[(straight > 0) & rays.origins.isfinite().all(-1)]  # a ray with NaN or infinity has no samples
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
        cell, sampled, leap, gap = _cell_at(cells, here)
        doublings = torch.where(sampled, cells.doublings_of(cell), 0)
        longer = (1 << doublings)[:, None]
        dt = dt * longer[:, 0]
        if cells.contracted:
            bent = (here.norm > 1) & here.nearing & (doublings > 0)
            dt = torch.where(bent, dt.minimum(NEARING * away), dt)
        if cells.contracted:
            gap = torch.where(here.norm > 1, gap.minimum(STRAIGHT * away), gap)
        steps = torch.where(leap > 0, (gap / dt).floor().clamp(min=0) + 1, 1.0)
        own = cell // longer
        within = here.position / longer - own
        found.append(tuple(v[sampled] for v in (alive, t[alive], dt, own, within, doublings)))
        t[alive] = t[alive] + steps * dt
    if not found:
        found.append((everyone[:0], t[:0], t[:0], everyone.new_zeros(0, 3), t.new_zeros(0, 3), everyone[:0]))
    merged = [torch.cat(parts) for parts in zip(*found, strict=True)]
    order = merged[0].argsort(stable=True)
    return Marched(*(v[order] for v in merged))
