"""Packed samples and the hash grid: the fast kernels against the plain ones, the plain ones against the equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_implementations import PLAIN, fast_packed
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels.packed_kernels import BoxSamples, HashLevels, PackedKernels, adam_numbers
from nerf_core.volume.cells import Cells
from nerf_core.volume.compositing import absorb, composite

LEVELS = HashLevels((2, 5, 11, 40))
MARCHED = 100 if "triton" in fast_packed() else 300  # rays; Triton's interpreter takes seconds for a block of them
WHITE = torch.tensor([1.0, 0.5, 0.25])
each_fast = pytest.mark.parametrize("kernels", fast_packed().values(), ids=fast_packed().keys())
each = pytest.mark.parametrize("kernels", [*fast_packed().values(), PLAIN], ids=[*fast_packed().keys(), "torch"])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_samples(rays: int = 40) -> tuple[BoxSamples, Tensor, Tensor]:
    """Rays with 0 … 9 samples, their optical depths (some opaque, some zero) and colours."""
    g = generator(1)
    counts = torch.randint(0, 10, (rays,), generator=g)
    counts[:2], counts[-1] = 0, 0
    total = int(counts.sum())
    row_offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    tau = torch.rand(total, generator=g)
    tau[::7], tau[3::11] = 0, 30
    samples = BoxSamples(
        row_offsets, torch.rand(total, generator=g), torch.ones(total), torch.rand(total, 3, generator=g)
    )
    return samples, tau, torch.rand(total, 3, generator=g)


def some_table(width: int) -> Tensor:
    return torch.randn(len(LEVELS.resolutions), 512, width, generator=generator(2))


def points(count: int = 300) -> Tensor:
    x = torch.rand(count, 3, generator=generator(3))
    x[0], x[1], x[2] = 0, 1, torch.tensor([1.0, 0.0, 0.5])  # the box's corners and an edge
    return x


@pytest.mark.parametrize("contracted", [False, True])
@each_fast
def test_a_march_finds_the_same_samples(kernels: PackedKernels, contracted: bool) -> None:
    g, count = generator(), MARCHED + 50  # more than one block
    half = 2.0 if contracted else 1.0
    occupied = torch.rand(9, 13, 10, generator=g) < 0.3
    occupied[:, 4:9] = False  # blocks to leap over
    cells = Cells.of(np.full(3, -half), 2 * half / np.array([9, 13, 10]), occupied, contracted)
    origins = 3 * (torch.rand(count, 3, generator=g) * 2 - 1)
    origins[:10] *= 0.2  # within the box
    d = torch.nn.functional.normalize(torch.rand(count, 3, generator=g) * 2 - 1 - origins, dim=-1)
    d[5], d[20], origins[20] = torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, 1.0]), torch.tensor([0.1, 0.2, -3])
    d[21], origins[21] = torch.tensor([0, 1.0, 0]), torch.tensor([9.0, 0, 0])  # beside the box, along its side
    far = torch.full((count,), 1e6)
    far[30] = -1.0
    rays, offsets = BoxRays(origins, d, d, torch.full((count,), 0.05), far), torch.rand(count, generator=g)
    a, b = (k.march(cells, rays, 0.6, offsets) for k in (kernels, PLAIN))
    same = a.row_offsets.diff() == b.row_offsets.diff()
    assert int((~same).sum()) <= 4  # a sample that lies on a cell's face may be rounded to either side of it
    mine, theirs = (s.at(same[s.ray].nonzero()[:, 0]) for s in (a, b))
    assert len(mine.t) > 2.5 * count
    torch.testing.assert_close(mine.x, theirs.x, atol=2e-2, rtol=0)
    torch.testing.assert_close(mine.t, theirs.t, atol=1e-2, rtol=1e-2)
    near = mine.t < 50  # farther out a step's length is mostly rounding
    torch.testing.assert_close(mine.width[near], theirs.width[near], atol=1e-2, rtol=1e-2)
    assert a.x.min() >= 0
    assert a.x.max() <= 1


@pytest.mark.parametrize("contracted", [False, True])
@each
def test_a_march_from_far_away_takes_steps_that_float32_can_tell_apart(
    kernels: PackedKernels, contracted: bool
) -> None:
    half = 2.0 if contracted else 1.0
    cells = Cells.of(np.full(3, -half), np.full(3, half / 16), torch.ones(32, 32, 32, dtype=torch.bool), contracted)
    away = torch.tensor([10.0, 1e4, 1e6, 1e8, 1e12, 1e25])
    origins = away[:, None] * torch.tensor([0.6, 0.0, 0.8])
    d = (-origins / away[:, None]).contiguous()
    last = 1e4 + 2 * away  # the horizon of contracted scenes
    samples = kernels.march(cells, BoxRays(origins, d, d, 0 * away, last), 0.5, torch.full_like(away, 0.5))
    counts = samples.row_offsets.diff()
    assert counts[0] >= 64
    assert counts.max() < 1000
    # the least step, 2⁻²² of the distance, is 1/4 at a distance of 10⁶: some samples still meet the box
    assert counts[2] >= 4
    assert bool((samples.width >= samples.t * 2.0**-22 * 0.99).all())
    assert bool(((samples.x >= 0) & (samples.x <= 1)).all())


@pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")  # numpy's, in Triton's interpreter
@pytest.mark.parametrize("contracted", [False, True])
@each
def test_an_invalid_ray_finds_no_samples(kernels: PackedKernels, contracted: bool) -> None:
    half = 2.0 if contracted else 1.0
    cells = Cells.of(np.full(3, -half), np.full(3, half / 4), torch.ones(8, 8, 8, dtype=torch.bool), contracted)
    bad = torch.tensor([torch.nan, torch.inf, -torch.inf])
    origins, d = torch.zeros(23, 3), torch.zeros(23, 3)
    d[:, 0] = 1
    origins[torch.arange(9), torch.arange(9) % 3] = bad.repeat_interleave(3)
    d[torch.arange(9, 18), torch.arange(9) % 3] = bad.repeat_interleave(3)
    near, far = torch.zeros(23), torch.full((23,), 3.0)
    near[18], far[19] = torch.nan, torch.nan
    d[20], near[21] = 0, torch.inf
    samples = kernels.march(cells, BoxRays(origins, d, d, near, far), 0.5, torch.full((23,), 0.5))
    counts = samples.row_offsets.diff()
    assert counts[:22].tolist() == [0] * 22
    assert counts[22] >= 8


@pytest.mark.parametrize("extent", [0.1, 1.0, 10.0])
@each
def test_leaps_miss_under_3_percent_of_the_samples(kernels: PackedKernels, extent: float) -> None:
    """In contracted space a leap follows the tangent of a bent ray. The rays here run from far outside to the middle.

    Box coordinates are world coordinates divided by the extent.
    """
    g, count = generator(), MARCHED
    occupied = torch.rand(12, 12, 12, generator=g) < 0.02
    for axis in range(3):
        occupied = occupied.repeat_interleave(4, axis)
    cells = Cells.of(np.full(3, -2.0), np.full(3, 4 / 48), occupied, contracted=True)
    origins = 8 * (torch.rand(count, 3, generator=g) * 2 - 1)
    d = torch.nn.functional.normalize(2 * torch.randn(count, 3, generator=g) - origins, dim=-1)
    rays = BoxRays(origins, d / extent, d, torch.full((count,), 0.01 * extent), torch.full((count,), 1e6 * extent))
    offsets = torch.rand(count, generator=g)
    leaping = kernels.march(cells, rays, 0.6, offsets)
    walking = PLAIN.march(replace(cells, leap=torch.zeros_like(cells.leap)), rays, 0.6, offsets)
    assert len(walking.t) > 1.3 * count
    assert len(leaping.t) > 0.97 * len(walking.t)


@each_fast
def test_a_march_fills_a_given_capacity(kernels: PackedKernels) -> None:
    cells = Cells.of(np.full(3, -1.0), np.full(3, 0.5), torch.rand(4, 4, 4, generator=generator()) < 0.5, False)
    d = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator(1)), dim=-1)
    rays = BoxRays(-2 * d + 0.2, d, d, torch.zeros(60), torch.full((60,), 9.0))
    found = kernels.march(cells, rays, 0.6, torch.zeros(60))
    for capacity in (len(found.t) // 2, len(found.t) + 50):
        fixed = kernels.march(cells, rays, 0.6, torch.zeros(60), capacity)
        n = min(capacity, len(found.t))
        assert len(fixed.t) == len(fixed.width) == len(fixed.x) == capacity
        assert torch.equal(fixed.row_offsets, found.row_offsets.clamp(max=capacity))
        for name in ("t", "width", "x"):
            assert torch.equal(getattr(fixed, name)[:n], getattr(found, name)[:n])
        assert not fixed.width[n:].any()


@pytest.mark.parametrize("width", [1, 2, 4])
@each_fast
def test_features_and_their_gradients_agree(kernels: PackedKernels, width: int) -> None:
    table, x = some_table(width), points()
    features = kernels.encode(table, LEVELS, x)
    torch.testing.assert_close(features, PLAIN.encode(table, LEVELS, x), atol=1e-5, rtol=1e-5)
    gradient = torch.randn(features.shape, generator=generator(4))
    found = [torch.zeros_like(table), torch.zeros_like(table)]
    for into, k in zip(found, (kernels, PLAIN), strict=True):
        k.encode_gradient(gradient, LEVELS, x, into)
    torch.testing.assert_close(found[0], found[1], atol=1e-4, rtol=1e-4)
    # encode_gradient is the transpose of encode: ⟨g, E table⟩ = ⟨Eᵀ g, table⟩
    assert float((gradient * features).sum()) == pytest.approx(float((found[0] * table).sum()), rel=1e-3)


@each
def test_a_dense_level_interpolates_its_vertices(kernels: PackedKernels) -> None:
    levels, table = HashLevels((4,)), torch.zeros(1, 128, 2)
    i, j, k = torch.meshgrid(*[torch.arange(5.0)] * 3, indexing="ij")
    table[0, :125, 0] = (i + 2 * j - 3 * k).flatten()
    x = points()
    expected = 4 * (x @ torch.tensor([1.0, 2.0, -3.0]))
    torch.testing.assert_close(kernels.encode(table, levels, x)[:, 0], expected, atol=1e-4, rtol=1e-4)


@each
@pytest.mark.parametrize("endless", [False, True])
def test_packed_rays_are_composited_like_full_ones(kernels: PackedKernels, endless: bool) -> None:
    """endless: the last sample of each ray is unbounded, with an optical depth of 10¹²."""
    samples, tau, rgb = some_samples()
    if endless:
        tau[samples.row_offsets[1:][samples.row_offsets.diff() > 0] - 1] = 1e12
    pixel = kernels.composite(tau, rgb, samples, WHITE)
    for r in range(len(samples.row_offsets) - 1):
        part = slice(int(samples.row_offsets[r]), int(samples.row_offsets[r + 1]))
        if part.start == part.stop:
            torch.testing.assert_close(pixel[r], torch.tensor([1.0, 0.5, 0.25, 0, 0]))
            continue
        _, _, weights = absorb(tau[None, part], torch.ones(1, part.stop - part.start))
        color, opacity = composite(weights, rgb[None, part], WHITE)
        torch.testing.assert_close(pixel[r, :3], color[0], atol=1e-5, rtol=1e-5)
        assert float(pixel[r, 3]) == pytest.approx(float(opacity[0]), abs=1e-5)
        assert float(pixel[r, 4]) == pytest.approx(float((weights[0] * samples.t[part]).sum()), abs=1e-5)


@each_fast
def test_the_gradient_of_compositing_is_autograds(kernels: PackedKernels) -> None:
    samples, tau, rgb = some_samples()
    gradient = torch.randn(len(samples.row_offsets) - 1, 3, generator=generator(5))
    for mine, theirs in zip(
        kernels.composite_gradient(gradient, tau, rgb, samples, WHITE),
        PLAIN.composite_gradient(gradient, tau, rgb, samples, WHITE),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)
        assert mine.isfinite().all()


def test_the_plain_gradient_is_that_of_finite_differences() -> None:
    samples, tau, rgb = some_samples()
    tau, rgb = tau.clamp(0.05, 2).double(), rgb.double()
    double = BoxSamples(samples.row_offsets, samples.t.double(), samples.width, samples.x)
    gradient = torch.randn(len(samples.row_offsets) - 1, 3, generator=generator(5)).double()
    by_tau, by_rgb = PLAIN.composite_gradient(gradient, tau, rgb, double, WHITE.double())
    step = (
        torch.randn(tau.shape, generator=generator(6)).double(),
        torch.randn(rgb.shape, generator=generator(7)).double(),
    )
    h = 1e-6

    def value(sign: float) -> float:
        moved = tau + sign * h * step[0], rgb + sign * h * step[1]
        return float((PLAIN.composite(*moved, double, WHITE.double())[:, :3] * gradient).sum())

    expected = float((by_tau * step[0]).sum() + (by_rgb * step[1]).sum())
    assert (value(1) - value(-1)) / (2 * h) == pytest.approx(expected, rel=1e-5)


@each_fast
def test_adam_moves_only_what_has_a_gradient(kernels: PackedKernels) -> None:
    results = []
    for k in (kernels, PLAIN):
        table = some_table(2)
        moments = torch.zeros_like(table), torch.zeros_like(table)
        for step in (1, 2, 3):
            gradient = torch.randn(table.shape, generator=generator(step))
            gradient[:, ::3] = 0
            k.adam(table, gradient, moments, adam_numbers(0.1, step))
            assert not gradient.any()
        assert torch.equal(table[:, ::3], some_table(2)[:, ::3])
        results.append((table, *moments))
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)


@each
def test_no_samples_at_all(kernels: PackedKernels) -> None:
    nothing = BoxSamples(torch.zeros(4, dtype=torch.long), torch.zeros(0), torch.zeros(0), torch.zeros(0, 3))
    pixel = kernels.composite(torch.zeros(0), torch.zeros(0, 3), nothing, WHITE)
    torch.testing.assert_close(pixel, torch.tensor([1.0, 0.5, 0.25, 0, 0]).expand(3, 5))
    by_tau, by_rgb = kernels.composite_gradient(torch.ones(3, 3), torch.zeros(0), torch.zeros(0, 3), nothing, WHITE)
    assert by_tau.shape == (0,)
    assert by_rgb.shape == (0, 3)
    assert kernels.encode(some_table(2), LEVELS, torch.zeros(0, 3)).shape == (0, 8)
