"""The voxel grid with torch operations: the plain reference for the fast kernels, and the fallback without them.

All rays march together, one step at a time. Autograd computes the gradient.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels.torch_march import march
from nerf_core.kernels.voxel_kernels import CALM, CLEAR, FLAT, HALVINGS, OPAQUE, OUTLIER, TURN_RAYS, Adam, March, Traced
from nerf_core.volume.compositing import STOP
from nerf_core.volume.voxel_grid import DENSITY, GLOSS, PARTS, WIDTH, VoxelGrid, colors_of


class VoxelSamples(NamedTuple):
    """M samples, ray after ray, front to back.

    ray: (M,). t, width: (M,). rows, weights: (M, 8), the rows of the cell's corners, z fastest, and their trilinear
    weights.
    """

    ray: Tensor
    t: Tensor
    width: Tensor
    rows: Tensor
    weights: Tensor


def voxel_samples(grid: VoxelGrid, rays: BoxRays, how: March) -> VoxelSamples:
    """March, and find the rows and weights of the samples' corners."""
    ray, t, width, cell, within, doublings = march(grid, rays, how.step, how.offsets)
    corners = torch.cartesian_prod(*[torch.arange(2, device=ray.device)] * 3)
    rows = grid.row_of((cell[:, None] + corners).reshape(-1, 3), doublings.repeat_interleave(8)).view(-1, 8)
    weights = torch.where(corners == 1, within[:, None], 1 - within[:, None]).prod(-1)
    return VoxelSamples(ray, t, width, rows, weights)


class Composited(NamedTuple):
    pixel: Tensor  # (R, 5)
    used: Tensor  # (M,) bool: whether the transmittance in front of the sample is at least STOP
    raw: Tensor
    alpha: Tensor
    transmittance: Tensor
    rgb: Tensor


def composite(
    rows: Tensor, samples: VoxelSamples, views: Tensor, step: float, bias: float, background: Tensor
) -> Composited:
    """Composite packed samples: NeRF Eq. 3. rows: (M, 16), the grid's. views: unit directions (R, 3)."""
    values = (samples.weights[..., None] * rows[samples.rows]).sum(1)
    raw = values[:, DENSITY] + bias
    rgb = colors_of(values, views[samples.ray])
    tau = (functional.softplus(raw) * step).double()  # in 64 bits: ray by ray differences of one running sum
    total = tau.cumsum(0)
    begins = torch.cat([torch.ones_like(samples.ray[:1], dtype=torch.bool), samples.ray[1:] != samples.ray[:-1]])
    first = (
        torch.where(begins, torch.arange(len(tau), device=tau.device), 0).cummax(0).values if len(tau) else samples.ray
    )
    before = (total - tau) - (total - tau)[first]
    used = torch.exp(-before) >= STOP
    tau = torch.where(used, tau, 0)
    alpha, transmittance = -torch.expm1(-tau).float(), torch.exp(-before).float()
    w = torch.where(used, alpha * transmittance, 0)
    count = len(views)
    color = torch.zeros(count, 3, device=w.device).index_add(0, samples.ray, w[:, None] * rgb)
    far = torch.zeros(count, device=w.device).index_add(0, samples.ray, w * samples.t)
    left = torch.exp(-torch.zeros(count, dtype=torch.float64, device=w.device).index_add(0, samples.ray, tau)).float()
    pixel = torch.cat([color + left[:, None] * background, (1 - left)[:, None], far[:, None]], -1)
    return Composited(pixel, used, raw, alpha, transmittance, rgb)


def _place_in_ray(t: Tensor, how: March) -> Tensor:
    """s; see `March`."""
    s = t / how.unit
    return s / (1 + s) if how.folded else s


def _distortion(samples: VoxelSamples, done: Composited, how: March, count: int) -> Tensor:
    """The distortion of all rays; see `March`. Each ray on its own, all pairs of its samples."""
    s, width = _place_in_ray(samples.t, how), samples.width / how.unit
    if how.folded:
        width = width * (1 - s).square()
    w = done.alpha * done.transmittance
    total = (w.square() * width)[done.used].sum() / 3
    for r in range(count):
        mine = done.used & (samples.ray == r)
        apart = (s[mine][:, None] - s[mine]).abs()
        total = total + (w[mine][:, None] * w[mine] * torch.where(apart < how.reach, apart, 0)).sum()
    return total


def _sides(like: Tensor) -> Tensor:
    """On which side of its cell each corner lies along x, y and z: (8, 3), −1 or 1."""
    return 2 * torch.cartesian_prod(*[torch.arange(2, device=like.device, dtype=like.dtype)] * 3) - 1


def _turns(samples: VoxelSamples, used: Tensor, raw: Tensor) -> Tensor:
    """Σ ln(1 + |d − (d · n) n|²) along the rays that count; see `March`. raw: (M, 8), the used samples' corners."""
    ray, rows = samples.ray[used], samples.rows[used]
    touch = (rows[:-1, :, None] == rows[1:, None]).any(-1).any(-1) & (rows[:-1, 0] != rows[1:, 0])
    pairs = touch & (ray[:-1] == ray[1:]) & (ray[1:] % TURN_RAYS == 0)
    rise = raw @ _sides(raw) / 4
    front, behind = rise[:-1][pairs], rise[1:][pairs]
    change, whole = behind - front, (front + behind).detach()
    across = (change * whole).sum(-1, keepdim=True) / (whole.square().sum(-1, keepdim=True) + FLAT)
    return (change - across * whole).square().sum(-1).log1p().sum()


class TorchVoxels:
    """`VoxelKernels` in torch operations, on any device."""

    name = "torch"

    def __init__(self) -> None:
        self.forget()

    def _fit(self, grid: VoxelGrid) -> None:
        if self._of is not grid.rows:
            self._of = grid.rows
            self._gradient = torch.zeros_like(grid.rows)
            self._touched, self._marks = (
                torch.zeros(len(grid.rows), dtype=kind, device=grid.rows.device) for kind in (torch.bool, torch.uint8)
            )

    def _composited(self, rows: Tensor, grid: VoxelGrid, rays: BoxRays, how: March) -> tuple[VoxelSamples, Composited]:
        samples = voxel_samples(grid, rays, how)
        return samples, composite(rows, samples, rays.views, how.step, how.bias, how.background)

    @torch.no_grad()
    def render(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Tensor:
        return self._composited(grid.rows, grid, rays, how)[1].pixel

    @torch.no_grad()
    def trace(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Traced:
        samples, done = self._composited(grid.rows, grid, rays, how)
        row_offsets = torch.searchsorted(samples.ray[done.used], torch.arange(len(rays) + 1, device=samples.ray.device))
        parts = (samples.t, samples.width, done.raw, done.alpha, done.transmittance, done.rgb)
        return Traced(row_offsets, *(v[done.used] for v in parts), pixel=done.pixel)

    def resample(self, old: VoxelGrid, new: VoxelGrid, first: int, last: int) -> Tensor:
        begin, step = (torch.from_numpy(v).to(new.rows.device) for v in old.at_vertex(new))
        at = begin + new.vertices(first, last) * step
        nearest = (at * 1024).round() / 1024
        at = torch.where((at - nearest).abs() < 1e-6, nearest, at)  # what rounding moved away from a vertex
        own = new.doublings_of_rows(first, last)
        most = torch.full_like(own, -1, dtype=torch.float32)
        best, rows = torch.zeros_like(own, dtype=torch.uint8), new.rows[new.rows_of(first, last)]
        sizes = range(len(old.tables))
        for d, tried in [(d, own + same == d) for same in (-1, 0) for d in sizes] + [(d, own >= 0) for d in sizes]:
            row, weight = self._lookup(old, at, d)
            held = weight.sum(-1)
            better = tried & (held > most + 1e-6)
            value = torch.einsum("pc,pcw->pw", weight, old.rows[row.clamp(min=0)])
            rows[better], best[better], most[better] = value[better], d, held[better]
        return best

    @staticmethod
    def _lookup(old: VoxelGrid, at: Tensor, d: int) -> tuple[Tensor, Tensor]:
        """The rows (P, 8) and weights (P, 8) at points among cells of d doublings; the weight is 0 where none is."""
        corners = torch.cartesian_prod(*[torch.arange(2, device=at.device)] * 3)
        size = torch.tensor([-(-n >> d) for n in old.size], device=at.device)
        place = at / (1 << d)
        cell = place.floor().long().clamp(min=0).minimum(size - 1)
        within = (place - cell).clamp(0, 1).float()
        weight = torch.where(corners == 1, within[:, None], 1 - within[:, None]).prod(-1)
        row = old.row_of((cell[:, None] + corners).view(-1, 3), d).view(-1, 8)
        return row, torch.where(row >= 0, weight, 0)

    def accumulate(self, grid: VoxelGrid, rays: BoxRays, truth: Tensor, how: March) -> tuple[float, int]:
        self._fit(grid)
        rows = grid.rows.detach().requires_grad_()
        samples, done = self._composited(rows, grid, rays, how)
        squared = (done.pixel[:, :3] - truth).square().sum()
        corner = samples.rows[done.used]
        values = rows[corner]
        sides = _sides(values)
        deviation = values - values.mean(1, keepdim=True)
        linear = (sides @ sides.T / 8) @ deviation  # the projection: the columns are orthogonal, their squares 8
        rough = ((deviation - linear).square() + how.slope * linear.square()).sum((0, 1))
        loss = (squared + how.smoothness * rough[DENSITY] + how.smoothness_color * rough[:DENSITY].sum()) / 2
        if how.turn > 0:
            loss = loss + how.turn / 2 * TURN_RAYS * _turns(samples, done.used, values[..., DENSITY])
        if how.distortion > 0:
            loss = loss + how.distortion * _distortion(samples, done, how, len(rays))
        self._add(loss, rows, corner)
        return float(squared.detach()), int(done.used.sum())

    def accumulate_depths(self, grid: VoxelGrid, rays: BoxRays, t: Tensor, how: March) -> None:
        self._fit(grid)
        rows = grid.rows.detach().requires_grad_()
        samples, done = self._composited(rows, grid, rays, how)
        placed = done.alpha * done.transmittance * _place_in_ray(samples.t, how)
        mean = torch.zeros(len(rays), device=t.device).index_add(0, samples.ray[done.used], placed[done.used])
        loss = functional.huber_loss(mean, _place_in_ray(t, how), reduction="sum", delta=OUTLIER)
        self._add(2 * how.depth * loss, rows, samples.rows[done.used])

    def _add(self, loss: Tensor, rows: Tensor, corner: Tensor) -> None:
        (gradient,) = torch.autograd.grad(loss, rows)
        self._gradient += gradient
        self._touched[corner.flatten()] = True

    def forget(self) -> None:
        self._of: Tensor | None = None  # the rows that the tensors below have the size of
        self._gradient = self._touched = self._marks = torch.empty(0)

    def gradient(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return self._gradient.clone()

    @torch.no_grad()
    def mark(self, grid: VoxelGrid, rays: BoxRays, how: March, spare: float) -> None:
        self._fit(grid)
        samples, done = self._composited(grid.rows, grid, rays, how)
        ray, alpha, front = samples.ray[done.used], done.alpha[done.used], done.transmittance[done.used]
        off = (done.rgb[done.used] - how.background).abs().amax(-1)
        plain = ((1 - done.pixel[ray, 3]) / (front * (1 - alpha)).clamp(min=1e-12)).clamp(max=1)
        weight = alpha * front * (1 - plain + plain * off)
        halvings = (-weight.log2()).floor().clamp(0, HALVINGS).long()  # floor: 2⁻ʰ ≥ w > 2⁻ʰ⁻¹
        sums = torch.zeros(len(rays), HALVINGS + 1, device=weight.device)
        sums.index_put_((ray, halvings), weight, accumulate=True)
        needed = sums.flip(1).cumsum(1).flip(1) > spare  # with all smaller groups
        corner = samples.rows[done.used]
        kept = needed[ray, halvings]
        worth = (1 + HALVINGS - halvings[kept]).to(torch.uint8)
        self._marks.scatter_reduce_(0, corner[kept, 0], worth, "amax")

    def marked(self, grid: VoxelGrid) -> Tensor:
        self._fit(grid)
        return self._marks.clone()

    def unmark(self) -> None:
        self._marks.zero_()

    def update(self, grid: VoxelGrid, moments: Tensor, ema: Tensor, adam: Adam) -> None:
        self._fit(grid)
        i = self._touched.nonzero()[:, 0]
        p, g = grid.rows[i], self._gradient[i]
        squares = torch.stack([g[:, part].square().mean(-1) for part in PARTS], -1)
        moments[i] = adam.beta2 * moments[i] + (1 - adam.beta2) * squares
        rates = torch.zeros(len(i), WIDTH, device=p.device)
        rates[:, :DENSITY], rates[:, :DENSITY:4], rates[:, DENSITY] = adam.rate_view, adam.rate_color, adam.rate_density
        rates[:, GLOSS] = adam.rate_gloss
        square = torch.fmax(moments[i] * adam.correction2, adam.least_square * squares)  # 0 · ∞ is no bound
        square = torch.cat([square[:, k : k + 1].expand(g[:, part].shape) for k, part in enumerate(PARTS)], -1)
        grid.rows[i] = p - rates * g / (square.sqrt() + adam.epsilon)
        if adam.harden > 0:
            opacity = torch.sigmoid(grid.rows[i, DENSITY] + adam.bias)  # 1 − e^−softplus(x) is the sigmoid
            left = ((1 - opacity) / OPAQUE).clamp(max=1) * CALM / (CALM + moments[i, 1] * adam.correction2)
            grid.rows[i, DENSITY] += adam.harden * adam.rate_density * (opacity - CLEAR) * left
        ema[i] += adam.ema_rate * (grid.rows[i] - ema[i])
        self.forget()
