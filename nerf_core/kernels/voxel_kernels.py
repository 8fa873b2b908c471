"""The interface of the kernels for a voxel grid. Every device has an implementation of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.volume.packed import Packed
from nerf_core.volume.voxel_grid import VoxelGrid

# From this error of the place s on, a ray's depth counts in proportion only (Huber): some sparse points are wrong, and
# squares would let those few decide. Folded, at a distance of one unit, where ds = dt / 4, it is 8 % of the distance.
OUTLIER = 0.02
MOST_SHARDS = 16  # on a CPU: each shard has its own gradients, 64 bytes a row
TURN_RAYS = 4  # one ray of so many counts in `turn` of `March`: it keeps a step from taking a fifth longer
FLAT = 1e-12  # added to |g + g′|² of `March`: it is 0 in a new grid, and rounding of densities near 1 leaves more
CLEAR = 0.12  # of `harden` of `Adam`: what lies before a surface is clearer than this, what lies in it is not
OPAQUE = 0.1  # of `harden`: a cell that lets less light than this through is opaque, and hardens more slowly
CALM = 2.5e-9  # of `harden`: between what v is at outlines and at fine detail, and what it is within smooth surfaces
HALVINGS = 24  # float32 tells weights down to 2⁻²⁴ from 0 beside 1


@dataclass(frozen=True)
class March:
    """How rays are sampled.

    step: length of a sample, in cells. Density is per cell, so that α = 1 − exp(−σ · step).
    bias: added to the raw density before softplus. background: (3,).
    offsets: (R,), where each ray's first sample lies in its step, 0 … 1.
    smoothness: weight of ½ (Σ b_k² + slope · Σ l_k²) over the 8 corners k of every sample's cell. The raw densities are
        mean + l_k + b_k there, where mean + l_k is the linear function nearest to them.
    smoothness_color: the same for each coefficient of colour. Gloss has none: g and −g are the same.
    slope: share of the linear part in both. With 0, density that rises linearly costs nothing, however steep it is; nor
        does any sum of functions of x, y and z alone.
    turn: weight of ½ ln(1 + |d − (d · n) n|²) over pairs of samples in succession whose cells are two that share a
        vertex. d = g′ − g is how the rise of raw density over a cell changes between them: g_x is the mean of the
        differences along its four edges in x. n = (g + g′) / |g + g′| is the direction of steepest rise, a surface's
        normal, and counts as given. So density may rise as it likes across a surface, but the normal should not turn
        from cell to cell. The logarithm (Cauchy's robust loss) spares edges, which turn by more than noise does. Only
        the rays 0, TURN_RAYS, 2 TURN_RAYS … count, each TURN_RAYS times: rays come in random order.
    distortion: weight λ of λ (Σ_ij w_i w_j |s_i − s_j| + ⅓ Σ_i w_i² Δs_i) for each ray, which draws its weights
        together (mip-NeRF 360, Eq. 15, arXiv:2111.12077). s = t / unit, or s/(1 + s) of it if `folded`.
    reach: over 0; only pairs with |s_i − s_j| < reach count, unlike in Eq. 15. So what makes one surface is drawn
        together, and two surfaces that a ray meets are not.
    depth: weight of the loss of `VoxelKernels.accumulate_depths`.
    """

    step: float
    bias: float
    background: Tensor
    offsets: Tensor
    smoothness: float = 0.0
    smoothness_color: float = 0.0
    slope: float = 1.0
    turn: float = 0.0
    distortion: float = 0.0
    reach: float = math.inf
    unit: float = 1.0
    folded: bool = False
    depth: float = 0.0


class Adam(NamedTuple):
    """The numbers of one step of Adam without first moments.

    p ← p − rate · g / (√max(v · correction2, least_square · g²) + epsilon), where g² is the mean over what shares v.

    rate_color, rate_view, rate_gloss, rate_density: learning rates of the coefficients of degree 0 and 1, of gloss, and
        of density.
    beta2: decay of the second moments v.
    correction2: bias correction 1/(1 − β₂ᵗ). epsilon: in units of a ray's gradient.
    least_square: no step (RMS over what shares v) is longer than rate / √least_square, however unlike those before it a
        gradient is; 0: any step. Else one that comes once would move a row by up to rate / √(1 − β₂). Adafactor's
        update clipping (arXiv:1804.04235) bounds the steps of whole tensors likewise.
    ema_rate: the EMA of the rows becomes ema + ema_rate · (row − ema).
    harden: raw density s also rises by
        harden · rate_density · (o − CLEAR) · min(1, (1 − o)/OPAQUE) · CALM / (CALM + v · correction2).
        o = 1 − e^−σ with σ = softplus(s + bias) is the opacity of a cell's length, and v is that of density. What is
        clearer than CLEAR becomes clearer still. What is opaque need not become more so: it would draw the surface,
        which lies between it and what is clear, outwards. Where v is large, photos pull at the density this way and
        that, and it is left to them.
    bias: that of `March`.
    """

    rate_color: float
    rate_view: float
    rate_gloss: float
    rate_density: float
    beta2: float
    correction2: float
    epsilon: float
    least_square: float
    ema_rate: float
    harden: float = 0.0
    bias: float = 0.0


@dataclass(frozen=True)
class Traced(Packed):
    """The samples from which `render` composites its pixels.

    raw: (M,), raw density with the bias. alpha, transmittance: (M,). rgb: (M, 3).
    pixel: (R, 5), colour over the background, opacity, Σ w t.
    """

    raw: Tensor
    alpha: Tensor
    transmittance: Tensor
    rgb: Tensor
    pixel: Tensor


class VoxelKernels(Protocol):
    """The operations. Gradients are summed inside until `update` applies them or `forget` drops them.

    Every cell of a grid has rows at its eight vertices; the kernels do not check that.
    """

    name: str

    def render(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Tensor:
        """The pixels of rays, (R, 5): colour over the background, opacity, Σ w t."""
        ...

    def trace(self, grid: VoxelGrid, rays: BoxRays, how: March) -> Traced:
        """The pixels of rays, with the samples from which they were composited."""
        ...

    def resample(self, old: VoxelGrid, new: VoxelGrid, first: int, last: int) -> Tensor:
        """Interpolate `old` at the vertices of bricks first ≤ b < last of `new`.

        A vertex of cells that are there in `old` takes its row, and one of cells that were divided is interpolated in
        them. Any other is interpolated among the smallest cells around it whose size has occupied cells at all corners,
        or at most of their weight; the other corners count as 0.
        Returns the doublings of those cells for each row of the bricks, uint8.
        """
        ...

    def accumulate(self, grid: VoxelGrid, rays: BoxRays, truth: Tensor, how: March) -> tuple[float, int]:
        """Add the gradient of ½ Σ squared error, and of smoothness, turn and distortion.

        truth: the colours of the photos (R, 3). Returns the sum of squared errors, and the number of samples.
        """
        ...

    def accumulate_depths(self, grid: VoxelGrid, rays: BoxRays, t: Tensor, how: March) -> None:
        """Add the gradient of λ Σ H(Σ_i w_i s_i − s*) over rays whose surface is known, λ = how.depth, s as in `March`.

        H(e) = e², beyond OUTLIER = o: o (2|e| − o). The mean place of a ray's light shall be that of a sparse point
        that lies on it; DS-NeRF (arXiv:2107.02791, Eq. 6–8) asks the same of the distribution of w.

        t: (R,) where the surfaces are, in the rays' t. Colours, smoothness, turn and distortion do not count.
        """
        ...

    def forget(self) -> None:
        """Drop gradients and marks, and free their memory."""
        ...

    def gradient(self, grid: VoxelGrid) -> Tensor:
        """The gradients summed so far, (M, 16)."""
        ...

    def mark(self, grid: VoxelGrid, rays: BoxRays, how: March, spare: float) -> None:
        """Mark the cells that the pixels of rays need.

        A ray's samples are put into groups of like weight w, 2⁻ʰ ≥ w > 2⁻ʰ⁻¹, h ≤ HALVINGS. The groups of the smallest
        weights, as many as have at most the weight `spare` together, are not needed: without their samples, no channel
        of the pixel changes by more than about `spare`. The cells of all other samples are marked.
        """
        ...

    def marked(self, grid: VoxelGrid) -> Tensor:
        """What the cells are worth, (M,) uint8.

        0 if no pixel needs the cell, else 1 + HALVINGS − h for its greatest weight, 2⁻ʰ ≥ w > 2⁻ʰ⁻¹. Where the pixel
        also shows the background, what the cell has of the background's colour does not count as weight.
        A cell is marked at the row of its lowest vertex.
        """
        ...

    def unmark(self) -> None:
        """Forget which cells are marked."""
        ...

    def update(self, grid: VoxelGrid, moments: Tensor, ema: Tensor, adam: Adam) -> None:
        """One step of Adam on the rows that have a gradient, and of their EMA (M, 16). Then drops the gradients.

        moments: (M, 3), the mean squares of the gradients of colour, density and gloss: one for each of `PARTS`.
        """
        ...
