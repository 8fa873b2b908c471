"""The fast voxel kernels against the plain ones, and the plain ones against the equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_implementations import fast_voxels
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels import numba_turn, numba_voxels
from nerf_core.kernels.cpu_voxels import CpuVoxels
from nerf_core.kernels.torch_voxels import TorchVoxels
from nerf_core.kernels.voxel_kernels import CALM, CLEAR, FLAT, OPAQUE, OUTLIER, TURN_RAYS, Adam, March, VoxelKernels
from nerf_core.volume.compositing import STOP
from nerf_core.volume.voxel_grid import DENSITY, GLOSS, PARTS, VoxelGrid, spread

WHITE = torch.ones(3)
FAST = fast_voxels()
Make = Callable[[], VoxelKernels]
each_fast = pytest.mark.parametrize("make", FAST.values(), ids=FAST.keys())
each = pytest.mark.parametrize("make", [*FAST.values(), TorchVoxels], ids=[*FAST.keys(), "torch"])


def some_grid(contracted: bool, size: tuple[int, int, int] = (11, 8, 13), dense: float = 0.3) -> VoxelGrid:
    g = torch.Generator().manual_seed(0)
    occupied = torch.rand(size, generator=g) < dense
    half = 2.0 if contracted else 1.0
    grid = VoxelGrid.over(np.full(3, -half), 2 * half / np.array(size), occupied, contracted)
    grid.rows[:] = torch.randn(grid.rows.shape, generator=g)
    return grid


def mixed_grid(contracted: bool) -> VoxelGrid:
    """Cells of three sizes side by side, and empty ones."""
    g = torch.Generator().manual_seed(7)
    kinds = spread(torch.randint(0, 4, (4, 3, 5), generator=g), 2)
    halves = spread(torch.randint(1, 3, tuple(n // 2 for n in kinds.shape), generator=g), 1)
    kinds = torch.where(kinds == 2, halves, kinds)
    kinds = torch.where((kinds == 1) & (torch.rand(kinds.shape, generator=g) < 0.5), 0, kinds).to(torch.uint8)
    half = 2.0 if contracted else 1.0
    grid = VoxelGrid.of_kinds(np.full(3, -half), 2 * half / np.array(kinds.shape), kinds, contracted)
    grid.rows[:] = torch.randn(grid.rows.shape, generator=g)
    assert len(grid.tables) == 3
    return grid


def some_rays(count: int = 200, seed: int = 1, spread: float = 3.0) -> BoxRays:
    """Rays from outside, from within, along the axes, past the box, and away from it."""
    g = torch.Generator().manual_seed(seed)
    origins = spread * (torch.rand(count, 3, generator=g) * 2 - 1)
    target = torch.rand(count, 3, generator=g) * 2 - 1
    d = torch.nn.functional.normalize(target - origins, dim=-1)
    axes = torch.eye(3)
    d[:6] = torch.cat([axes, -axes])
    origins[:6] = -2.5 * d[:6] + 0.13 * (1 - d[:6].abs())
    origins[6:9], d[6:9] = 0.21, axes  # from within, parallel to an axis
    origins[9], d[9] = torch.tensor([5.0, 0, 0]), torch.tensor([1.0, 0, 0])  # away
    origins[10], d[10] = torch.tensor([0.0, 4.0, -5.0]), torch.tensor([0.0, 0, 1.0])  # past
    return BoxRays(origins, d, d, torch.full((count,), 0.05), torch.full((count,), 1e6))


def how(count: int, **changes: float) -> March:
    offsets = torch.rand(count, generator=torch.Generator().manual_seed(5))
    return replace(March(0.7, -1.0, WHITE, offsets), **changes)


@pytest.mark.parametrize("contracted", [False, True])
@each_fast
@pytest.mark.parametrize("dense", [0.02, 0.3, 1.0, None], ids=["sparse", "some", "full", "mixed"])
def test_pictures_and_gradients_agree_with_the_reference(contracted: bool, make: Make, dense: float | None) -> None:
    grid, rays = mixed_grid(contracted) if dense is None else some_grid(contracted, dense=dense), some_rays()
    truth = torch.rand(len(rays), 3, generator=torch.Generator().manual_seed(2))
    march = how(len(rays), smoothness=0.1, smoothness_color=0.2, distortion=0.3, unit=1.7, folded=contracted)
    march = replace(
        march, reach={0.02: 0.4, 0.3: 0.01, None: 0.1}.get(dense, math.inf), slope=1.0 if contracted else 0.1,
        turn=0.0 if dense == 0.3 and contracted else 0.2,
    )  # fmt: skip
    fast, plain = make(), TorchVoxels()
    a, b = fast.render(grid, rays, march), plain.render(grid, rays, march)
    torch.testing.assert_close(fast.trace(grid, rays, march).pixel, a, atol=1e-4, rtol=1e-4)
    # rounding may put a sample that lies on a cell's face on the other side of it
    for got, expected in ((a[:, :4], b[:, :4]), (a[:, 4:] / (1 + b[:, 4:]), b[:, 4:] / (1 + b[:, 4:]))):
        assert float((got - expected).abs().amax(-1).sort().values[-3]) < 1e-3
        assert float((got - expected).abs().mean()) < 1e-4
    results = [k.accumulate(grid, rays, truth, march) for k in (fast, plain)]
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-4)
    assert results[0][1] == pytest.approx(results[1][1], rel=2e-3, abs=2)
    a, b = fast.gradient(grid), plain.gradient(grid)
    assert float((a - b).norm()) <= 2e-3 * float(b.norm())
    for kernels in (fast, plain):
        kernels.mark(grid, rays, march, 0.01)
    assert plain.marked(grid).any()
    assert float((fast.marked(grid) != plain.marked(grid)).float().mean()) < 2e-3
    for kernels in (fast, plain):
        kernels.unmark()
        assert not kernels.marked(grid).any()


@each
def test_smoothness_without_slope_spares_what_is_linear(make: Make) -> None:
    grid, rays, truth = some_grid(False, dense=1.0), some_rays(50), torch.zeros(50, 3)
    grid.rows[:, : GLOSS.start] = (
        grid.vertices().float() @ torch.tensor([0.1, -0.2, 0.3])[:, None] * torch.arange(13) / 9
    )

    def added(**changes: float) -> Tensor:
        """Return what smoothness adds to the gradient."""
        found = []
        for march in (how(50), how(50, smoothness=2.0, smoothness_color=3.0, **changes)):
            kernels = make()
            kernels.accumulate(grid, rays, truth, march)
            found.append(kernels.gradient(grid))
        return found[1] - found[0]

    sloped = added(slope=0.5)
    assert float(added(slope=0.0).abs().max()) < 1e-5 * float(sloped.abs().max())
    torch.testing.assert_close(2 * sloped, added(slope=1.0), atol=1e-3, rtol=1e-4)
    grid.rows[:] *= (grid.vertices()[:, :1] % 2 == 0) * (grid.vertices()[:, 1:2] % 2 == 0)
    assert float(added(slope=0.0)[:, DENSITY].abs().max()) > 0.1 * float(sloped[:, DENSITY].abs().max())


def added_by_turn(make: Make, grid: VoxelGrid, rays: BoxRays) -> Tensor:
    """Return what a weight of 2 adds to the gradient of the raw densities, for one ray of TURN_RAYS."""
    found = []
    for march in (how(len(rays), turn=0.0), how(len(rays), turn=2.0)):
        kernels = make()
        kernels.accumulate(grid, rays, torch.zeros(len(rays), 3), march)
        found.append(kernels.gradient(grid)[:, DENSITY])
    return (found[1] - found[0]) / TURN_RAYS


def along_x(cells: list[bool]) -> tuple[VoxelGrid, BoxRays]:
    """Cells of side 1 in a row, from the origin on, and a ray through their middles."""
    grid = VoxelGrid.over(np.zeros(3), np.ones(3), torch.tensor(cells)[:, None, None], contracted=False)
    to = torch.tensor([[1.0, 0, 0]])
    return grid, BoxRays(torch.tensor([[-1.0, 0.5, 0.5]]), to, to, torch.zeros(1), torch.full((1,), 9.0))


@each
def test_a_turn_between_two_cells_adds_the_gradient_of_its_equation(make: Make) -> None:
    """Density rises along y, and from x = 1 on it turns towards z: g = (0, 1, 0), g′ = (1.5, 1, 1.5)."""
    grid, ray = along_x([True, True])
    x, y, z = grid.vertices().unbind(-1)
    grid.rows[:, DENSITY] = -2.0 + y + 3 * z * (x == 2)
    n = torch.nn.functional.normalize(torch.tensor([1.5, 2.0, 1.5]), dim=0)
    d = torch.tensor([1.5, 0.0, 1.5])
    across = d - (d @ n) * n
    pull = across / (1 + across @ across)  # ∂/∂d of ½ ln(1 + |across|²)
    ends = 2.0 * torch.stack([y, z], -1) - 1
    sides = {0: (-1, 0), 1: (1, -1), 2: (0, 1)}  # of a vertex along x, in the first cell and in the second
    expected = torch.zeros(len(x))
    for cell, sign in enumerate((-1, 1)):
        for v in range(len(x)):
            if side := sides[int(x[v])][cell]:
                expected[v] += 2 * sign * (pull @ torch.tensor([side, *ends[v].tolist()])) / 4
    torch.testing.assert_close(added_by_turn(make, grid, ray), expected, atol=1e-5, rtol=1e-4)


@each
def test_turn_spares_any_profile_in_one_direction_and_cells_apart(make: Make) -> None:
    grid, rays = some_grid(False, dense=1.0), some_rays(50)
    profile = torch.tensor([-4.0, 1, 0.5, -2, 3, 3, 0, -1, 2, 5, 1, 0, 2, 1])
    grid.rows[:, DENSITY] = profile[grid.vertices()[:, 2]]
    assert float(added_by_turn(make, grid, rays).abs().max()) < 1e-5
    grid.rows[:, DENSITY] += (grid.vertices()[:, 0] % 2).float()
    assert float(added_by_turn(make, grid, rays).abs().max()) > 0.1
    grid, ray = along_x([True, False, True])
    grid.rows[:, DENSITY] = torch.randn(len(grid.rows), generator=torch.Generator().manual_seed(0)) - 2
    assert float(added_by_turn(make, grid, ray).abs().max()) < 1e-6


@each
def test_a_turn_needs_two_samples_of_one_ray_that_counts_that_light_reaches_in_cells_of_one_size(make: Make) -> None:
    grid, ray = along_x([True, True])
    grid.rows[:, DENSITY] = torch.randn(len(grid.rows), generator=torch.Generator().manual_seed(0)) - 2
    alone = added_by_turn(make, grid, ray)
    assert float(alone.abs().max()) > 0.1
    for rays, counted in ((TURN_RAYS, 1), (TURN_RAYS + 1, 2)):
        more = BoxRays(*(torch.cat([v] * rays) for v in vars(ray).values()))
        torch.testing.assert_close(added_by_turn(make, grid, more), counted * alone, atol=1e-5, rtol=1e-4)
    grid.rows[:, DENSITY] += 100 * (grid.vertices()[:, 0] < 2)  # no light leaves the first cell
    assert float(added_by_turn(make, grid, ray).abs().max()) < 1e-6

    kinds = torch.ones(4, 2, 2, dtype=torch.uint8)
    kinds[:2] = 2  # one cell of twice the size, and beside it eight
    grid = VoxelGrid.of_kinds(np.zeros(3), np.full(3, 0.5), kinds, contracted=False)
    of_large = grid.doublings_of_rows() == 1
    grid.rows[:, DENSITY] = torch.where(of_large, grid.vertices()[:, 2], grid.vertices()[:, 1]) - 2.0
    assert of_large.any()
    assert float(added_by_turn(make, grid, ray).abs().max()) < 1e-6


def test_loops_add_the_same_to_a_square_that_may_be_zero() -> None:
    assert (np.float32(FLAT), TURN_RAYS) == (numba_turn.FLAT, numba_turn.TURN_RAYS)
    written_out = numba_voxels.CLEAR, numba_voxels.OPAQUE, numba_voxels.CALM
    assert (np.float32(CLEAR), np.float32(OPAQUE), np.float32(CALM)) == written_out


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("spare", [0.004, 0.03, 0.1])
@each
def test_without_the_cells_that_are_not_marked_no_pixel_changes_by_more_than_the_spare_weight(
    contracted: bool, spare: float, make: Make
) -> None:
    """Not even if only some of them are dropped."""
    grid, rays, kernels = some_grid(contracted, dense=1.0), some_rays(300), make()
    grid.rows[:, DENSITY] = 2 * grid.rows[:, DENSITY] - 6  # thin haze, and some surfaces
    march = how(len(rays))
    kernels.mark(grid, rays, march, spare)
    needed = grid.cells_with(kernels.marked(grid))[0] > 0
    before = kernels.render(grid, rays, march)
    some = torch.rand(grid.size, generator=torch.Generator().manual_seed(1)) < 0.5
    for kept in (needed, needed | some):
        assert kept.sum() < grid.occupied.sum()
        fewer, rows = grid.with_cells(kept)
        changed = (kernels.render(replace(fewer, rows=grid.rows[rows]), rays, march) - before)[:, :3].abs().amax(-1)
        # a contracted ray's next samples shift a little where it leaps over dropped cells
        most = float(changed.sort().values[-30 if contracted else -1])
        assert 0 < most <= 1.05 * spare


def test_haze_of_the_backgrounds_colour_is_needed_only_in_front_of_something() -> None:
    occupied = torch.zeros(4, 4, 4, dtype=torch.bool)
    occupied[0], occupied[3, :, 2:] = True, True
    grid = VoxelGrid.over(np.full(3, -2.0), np.ones(3), occupied, contracted=False)
    grid.rows[:, :DENSITY:4] = 40.0  # white
    vertex = grid.vertices()
    grid.rows[vertex[:, 0] >= 3, :DENSITY:4] = -40.0  # black
    grid.rows[:, DENSITY] = torch.where(vertex[:, 0] >= 3, 50.0, -3.0)
    origins = torch.tensor([[-5.0, y, z] for y in (-1.5, 1.5) for z in (-1.5, 1.5)])
    ahead = torch.tensor([[1.0, 0, 0]]).expand(4, 3)
    rays = BoxRays(origins, ahead, ahead, torch.zeros(4), torch.full((4,), 100.0))
    for kernels in (CpuVoxels(1), TorchVoxels()):
        kernels.mark(grid, rays, March(1.0, 0.0, WHITE, torch.full((4,), 0.5)), 0.01)
        (worth,) = grid.cells_with(kernels.marked(grid))
        assert [bool(worth[0, y, z]) for y in (0, 3) for z in (0, 3)] == [False, True, False, True]


@pytest.mark.parametrize(("folded", "reach"), [(False, math.inf), (True, math.inf), (False, 0.4), (True, 0.1)])
def test_distortion_has_the_gradient_of_its_formula(folded: bool, reach: float) -> None:
    """mip-NeRF 360's Eq. 15, written out for all pairs of samples within reach, against finite differences."""
    grid, rays = some_grid(False, size=(4, 5, 4), dense=1.0), some_rays(40)
    grid.rows[:, DENSITY] -= 1.5
    march = how(40, distortion=0.7, reach=reach, unit=1.3, folded=folded)
    kernels = CpuVoxels(2)
    apart: list[float] = []

    def loss() -> float:
        found, total = kernels.trace(grid, rays, march), 0.0
        s, width, w = found.t.double() / 1.3, found.width.double() / 1.3, (found.alpha * found.transmittance).double()
        for r in range(40):
            part = slice(int(found.row_offsets[r]), int(found.row_offsets[r + 1]))
            at, long = (s[part] / (1 + s[part]), width[part] / (1 + s[part]) ** 2) if folded else (s[part], width[part])
            distance = (at[:, None] - at).abs()
            apart.append(float(distance.max()) if len(distance) else 0.0)
            pairs = w[part][:, None] * w[part] * torch.where(distance < reach, distance, 0)
            total += 0.7 * float(pairs.sum() + (w[part] ** 2 * long).sum() / 3)
        return total

    kernels.accumulate(grid, rays, kernels.render(grid, rays, march)[:, :3], march)  # no error of colour
    gradient = kernels.gradient(grid)
    assert float(gradient.norm()) > 0.01
    for seed in range(4):
        direction = torch.randn(grid.rows.shape, generator=torch.Generator().manual_seed(seed))
        above, below = (replace(grid, rows=grid.rows + h * direction) for h in (3e-3, -3e-3))
        keep, grid = grid, above
        high, grid = loss(), below
        low, grid = loss(), keep
        assert (high - low) / 6e-3 == pytest.approx(float((gradient * direction).sum()), rel=2e-2, abs=2e-4)
    assert math.isinf(reach) or max(apart) > reach > min(a for a in apart if a > 0)


@pytest.mark.parametrize("folded", [False, True])
@each
def test_depths_have_the_gradient_of_their_formula(folded: bool, make: Make) -> None:
    """λ Σ H(Σ w s − s*), where some depths are nearly right and some are outliers, against finite differences."""
    grid, rays = some_grid(folded, size=(4, 5, 4), dense=1.0), some_rays(40)
    grid.rows[:, DENSITY] -= 1.5
    march, kernels = how(40, depth=3.0, unit=1.3, folded=folded, distortion=9.0, smoothness=9.0), make()

    def place(t: Tensor) -> Tensor:
        return t / 1.3 / (1 + t / 1.3) if folded else t / 1.3

    def mean() -> Tensor:
        found = kernels.trace(grid, rays, march)
        ray = torch.repeat_interleave(torch.arange(40), found.row_offsets.diff())
        return torch.zeros(40, dtype=torch.float64).index_add(
            0, ray, (found.alpha * found.transmittance * place(found.t)).double()
        )

    near = mean() + torch.linspace(-0.015, 0.015, 40)
    near = torch.where(torch.arange(40) % 3 == 0, near + 0.2, near).clamp(0, 0.9)
    t = (1.3 * (near / (1 - near) if folded else near)).float()

    def loss() -> float:
        e = (mean() - place(t)).abs()
        return 3 * float(torch.where(e < OUTLIER, e**2, OUTLIER * (2 * e - OUTLIER)).sum())

    kernels.accumulate(grid, rays, torch.zeros(40, 3), march)  # leaves numbers in the scratch
    kernels.forget()
    kernels.accumulate_depths(grid, rays, t, march)
    gradient = kernels.gradient(grid).clone()
    assert float(gradient[:, DENSITY].norm()) > 0.01
    assert not gradient[:, :DENSITY].any()
    assert not gradient[:, GLOSS].any()
    for seed in range(4):
        direction = torch.zeros_like(grid.rows)
        direction[:, DENSITY] = torch.randn(len(grid.rows), generator=torch.Generator().manual_seed(seed))
        grid.rows.add_(3e-3 * direction)
        above = loss()
        grid.rows.sub_(6e-3 * direction)
        below = loss()
        grid.rows.add_(3e-3 * direction)
        assert (above - below) / 6e-3 == pytest.approx(float((gradient * direction).sum()), rel=2e-2, abs=2e-4)


@pytest.mark.parametrize("contracted", [False, True])
@each_fast
def test_gradients_of_depths_agree_with_the_reference(contracted: bool, make: Make) -> None:
    """Also on grids with holes and of several sizes, where rays end early, miss, or are opaque."""
    grid, rays = mixed_grid(contracted), some_rays()
    march = how(len(rays), depth=0.4, unit=1.7, folded=contracted)
    t = 4 * torch.rand(len(rays), generator=torch.Generator().manual_seed(2))
    gradients = []
    for kernels in (make(), TorchVoxels()):
        kernels.accumulate_depths(grid, rays, t, march)
        gradients.append(kernels.gradient(grid))
    a, b = gradients
    assert float((a - b).norm()) <= 2e-3 * float(b.norm())


@pytest.mark.parametrize("contracted", [False, True])
@each
def test_the_gradient_is_that_of_finite_differences(contracted: bool, make: Make) -> None:
    grid, rays = some_grid(contracted, size=(4, 5, 4), dense=1.0), some_rays(40)
    grid.rows[:, DENSITY] -= 1.5  # so that no ray is cut off at a low transmittance: the cut-off is not smooth
    truth = torch.rand(40, 3, generator=torch.Generator().manual_seed(2))
    kernels, march = make(), how(40)

    def loss() -> float:
        return float((kernels.render(grid, rays, march)[:, :3] - truth).double().square().sum()) / 2

    assert float(kernels.render(grid, rays, march)[:, 3].max()) < 1 - STOP
    kernels.accumulate(grid, rays, truth, march)
    gradient = kernels.gradient(grid)
    g = torch.Generator().manual_seed(4)
    for _ in range(4):
        direction = torch.randn(grid.rows.shape, generator=g)
        h = 3e-3
        grid.rows.add_(h * direction)
        above = loss()
        grid.rows.sub_(2 * h * direction)
        below = loss()
        grid.rows.add_(h * direction)
        assert (above - below) / (2 * h) == pytest.approx(float((gradient * direction).sum()), rel=2e-2, abs=1e-3)


@each
def test_a_ray_through_one_opaque_cell_has_the_colour_of_its_coefficients(make: Make) -> None:
    occupied = torch.zeros(4, 4, 4, dtype=torch.bool)
    occupied[2, 1, 1] = True
    grid = VoxelGrid.over(np.full(3, -2.0), np.ones(3), occupied, contracted=False)
    grid.rows[:, DENSITY] = 50
    grid.rows[:, 0], grid.rows[:, 4], grid.rows[:, 8] = 4.0, -4.0, 0.0
    ray = BoxRays(
        torch.tensor([[-5.0, -0.5, -0.5]]), torch.tensor([[1.0, 0, 0]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1),
        torch.full((1,), 100.0),
    )  # fmt: skip
    pixel = make().render(grid, ray, March(0.25, 0.0, WHITE, torch.tensor([0.5])))[0]
    expected = torch.sigmoid(torch.tensor([4.0, -4.0, 0.0]) * 0.28209479)
    torch.testing.assert_close(pixel[:3], expected, atol=1e-3, rtol=0)
    assert float(pixel[3]) == pytest.approx(1, abs=1e-3)
    assert float(pixel[4]) == pytest.approx(5.125, abs=0.3)  # the cell begins at x = 0


@pytest.mark.parametrize("dense", [0.05, 0.3, 1.0])
@each_fast
def test_grids_are_resampled_alike(make: Make, dense: float) -> None:
    """The new box reaches beyond the old one, and many of the old vertices are not stored."""
    old, g = mixed_grid(False) if dense == 0.3 else some_grid(False, dense=dense), torch.Generator().manual_seed(3)
    occupied = torch.rand(17, 9, 14, generator=g) < 0.4
    new = [VoxelGrid.over(np.array([-1.2, -0.7, -0.9]), np.array([0.13, 0.2, 0.17]), occupied, False) for _ in range(2)]
    found: list[list[Tensor]] = [[], []]
    for kernels, grid, sizes in zip((make(), TorchVoxels()), new, found, strict=True):
        for first in range(0, grid.brick_count, 7):
            sizes.append(kernels.resample(old, grid, first, min(first + 7, grid.brick_count)))
    assert torch.equal(*(torch.cat(sizes) for sizes in found))
    assert new[0].rows.count_nonzero() > 0.2 * new[0].rows[:, : DENSITY + 1].numel()
    torch.testing.assert_close(new[0].rows, new[1].rows, atol=1e-5, rtol=1e-5)


@each
def test_empty_grids_and_rays_that_miss_show_background_and_have_no_gradient(make: Make) -> None:
    grid, rays, kernels = some_grid(False, dense=0.0), some_rays(), make()
    pixel = kernels.render(grid, rays, how(len(rays)))
    assert torch.equal(pixel[:, :3], torch.ones(len(rays), 3))
    assert not pixel[:, 3:].any()
    assert kernels.accumulate(grid, rays, torch.ones(len(rays), 3), how(len(rays))) == (0, 0)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("contracted", [False, True])
def test_no_sample_reads_a_missing_row(contracted: bool, mixed: bool) -> None:
    """A point on a cell's face must not be found in one cell and looked up in its neighbour. Missing rows are NaN."""
    grid = mixed_grid(contracted) if mixed else some_grid(contracted, size=(53, 51, 67), dense=0.02)
    around = torch.full((len(grid.rows) + 128, 16), torch.nan)
    around[64:-64] = grid.rows
    grid = replace(grid, rows=around[64:-64])
    kernels = CpuVoxels(2)
    for seed in range(4):
        rays = some_rays(150_000, seed)
        march = March(0.7, -3.0, WHITE, torch.rand(len(rays), generator=torch.Generator().manual_seed(seed)))
        assert kernels.render(grid, rays, march).isfinite().all()
        error, _ = kernels.accumulate(grid, rays, torch.zeros(len(rays), 3), march)
        assert np.isfinite(error)


@pytest.mark.parametrize("contracted", [False, True])
@each
def test_nothing_is_ever_nan(contracted: bool, make: Make) -> None:
    grid, rays = some_grid(contracted), some_rays(spread=1.0)
    grid.rows[:, DENSITY] *= 40  # from perfectly clear to perfectly opaque
    grid.rows[:, :DENSITY] *= 40
    kernels = make()
    assert kernels.render(grid, rays, how(len(rays))).isfinite().all()
    kernels.accumulate(grid, rays, torch.rand(len(rays), 3), how(len(rays)))
    assert kernels.gradient(grid).isfinite().all()


@pytest.mark.parametrize("least_square", [0.0, 2.0])
@each_fast
def test_adam_agrees_with_the_reference(make: Make, least_square: float) -> None:
    truth, rays = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)), some_rays()
    settings = Adam(0.2, 0.1, 0.05, 0.3, 0.99, 100.0, 1e-4, least_square, 0.3, harden=4 * least_square, bias=-1.0)
    results: list[tuple[Tensor, ...]] = []
    for kernels in (make(), TorchVoxels()):
        grid = some_grid(False)
        moments, ema, expected = torch.zeros(len(grid.rows), 3), grid.rows.clone(), grid.rows.clone()
        for _ in range(3):
            before = grid.rows.clone()
            kernels.accumulate(grid, rays, truth, how(200))
            kernels.update(grid, moments, ema, settings)
            moved = (grid.rows != before).any(-1)  # the rows with a gradient
            expected[moved] += 0.3 * (grid.rows - expected)[moved]
        torch.testing.assert_close(ema, expected, rtol=1e-5, atol=1e-6)
        results.append((grid.rows, moments, ema))
    for fast, plain in zip(*results, strict=True):
        assert float((fast - plain).norm()) <= 5e-3 * float(plain.norm())


@each
def test_opaque_density_hardens_where_photos_hardly_pull_at_it(make: Make) -> None:
    """Two rays along x in two rows of cells: one whose colour is right, and one whose squared error is 3 · 0.8²."""
    grid = some_grid(False, (6, 2, 1), dense=1.0)
    grid.rows[:, :DENSITY] = 0  # grey
    grid.rows[:, GLOSS] = 0
    grid.rows[:, DENSITY] = grid.vertices()[:, 0] - 2.0  # both rays end at one x
    to = torch.tensor([1.0, 0.0, 0.0]).expand(2, 3)
    origins = torch.tensor([[-3.0, -0.7, 0.0], [-3.0, 0.7, 0.0]])
    rays = BoxRays(origins, to, to, torch.zeros(2), torch.full((2,), 9.0))
    march = how(2)
    shown = TorchVoxels().render(grid, rays, march)[:, :3]
    truth, rates = shown - torch.tensor([[0.0], [0.8]]), (0.0, 0.0, 0.0, 0.25)
    risen, squares = [], torch.zeros(0)
    for harden in (0.0, 0.4):
        one, kernels = replace(grid, rows=grid.rows.clone()), make()
        kernels.accumulate(one, rays, truth, march)
        moments, ema = torch.zeros(len(grid.rows), 3), grid.rows.clone()
        adam = Adam(*rates, 0.99, 50.0, 1e-3, 0.25, 1.0, harden, -1.0)
        kernels.update(one, moments, ema, adam)
        risen.append(one.rows)
        squares = 50 * moments[:, 1]
    added = risen[1] - risen[0]
    right = (grid.vertices()[:, 1] == 0) & added[:, DENSITY].bool()
    wrong = (grid.vertices()[:, 1] > 0) & (squares > 3 * CALM)
    assert int(right.sum()) >= 8
    assert int(wrong.sum()) >= 8
    opacity = 1 - torch.exp(-torch.nn.functional.softplus(risen[0][:, DENSITY] - 1))
    law = 0.1 * (opacity - CLEAR) * ((1 - opacity) / OPAQUE).clamp(max=1)
    for rows, share in (right, torch.ones(())), (wrong, CALM / (CALM + squares[wrong])):
        torch.testing.assert_close(added[rows, DENSITY], law[rows] * share, atol=1e-6, rtol=1e-4)
    assert (opacity[right] > 1 - OPAQUE / 2).any()  # opaque already, and hardens at less than half of the speed
    assert (added[right, DENSITY] < 0).any()  # clear, and becomes clearer
    assert (added[right, DENSITY] > 0).any()
    assert not added[:, :DENSITY].any()


@each
def test_a_gradient_that_comes_once_moves_rows_by_a_bounded_step(make: Make) -> None:
    # RMS of steps over what shares a second moment: at most rate / √least_square, and up to rate / √(1 − β₂) without
    rays, rates, longest = some_rays(), (0.1, 0.1, 0.1, 0.1), []
    truth = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    for least_square in (0.0, 0.25):
        grid, kernels = some_grid(False), make()
        before = grid.rows.clone()
        kernels.accumulate(grid, rays, truth, how(200))
        moments, ema = torch.zeros(len(grid.rows), 3), grid.rows.clone()
        kernels.update(grid, moments, ema, Adam(*rates, 0.99, 1.0, 1e-12, least_square, 1.0))
        moved = (grid.rows - before) / 0.1
        steps = torch.stack([moved[:, part].square().mean(-1).sqrt() for part in PARTS], -1)
        longest.append(steps.amax(0))
    torch.testing.assert_close(longest[0], torch.full((3,), 10.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(longest[1], torch.full((3,), 2.0), rtol=1e-3, atol=0)


@pytest.mark.parametrize("least_square", [0.0, 0.25])
@each
def test_a_gradient_whose_square_overflows_leaves_rows_finite(make: Make, least_square: float) -> None:
    grid, kernels = some_grid(False), make()
    while kernels.gradient(grid)[:, DENSITY].abs().max() < 2e19:  # the squared error of each batch is finite
        kernels.accumulate(grid, some_rays(), torch.full((200, 3), 7e17), how(200))
    moments, ema = torch.zeros(len(grid.rows), 3), grid.rows.clone()
    kernels.update(grid, moments, ema, Adam(0.1, 0.1, 0.1, 0.1, 0.99, 1.0, 1e-5, least_square, 1.0))
    assert moments.isinf().any()
    assert grid.rows.isfinite().all()


def test_the_same_thread_count_gives_the_same_bits() -> None:
    rays, truth = some_rays(3000), torch.rand(3000, 3, generator=torch.Generator().manual_seed(2))
    grid = some_grid(True)
    found = []
    for _ in range(3):
        kernels = CpuVoxels(3)
        kernels.accumulate(grid, rays, truth, how(3000))
        found.append(kernels.gradient(grid))
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


@each
def test_forgotten_gradients_leave_no_trace(make: Make) -> None:
    grid, rays, kernels = some_grid(False), some_rays(), make()
    kernels.accumulate(grid, rays, torch.zeros(200, 3), how(200))
    kernels.forget()
    before, moments, ema_rows = grid.rows.clone(), torch.zeros(len(grid.rows), 3), torch.zeros_like(grid.rows)
    kernels.update(grid, moments, ema_rows, Adam(0.2, 0.1, 0.05, 0.3, 0.99, 100.0, 1e-4, 0.25, 1.0))
    assert torch.equal(grid.rows, before)
    assert not moments.any()
    assert not ema_rows.any()


@each
def test_other_rows_of_the_same_grid_begin_without_gradients_and_marks(make: Make) -> None:
    grid, rays, kernels, fresh = some_grid(False), some_rays(), make(), make()
    other, truth = replace(grid, rows=grid.rows.clone()), torch.zeros(200, 3)
    kernels.accumulate(grid, rays, truth, how(200))
    kernels.mark(grid, rays, how(200), 0.01)
    assert not kernels.marked(other).any()
    assert not kernels.gradient(other).any()
    for one in (kernels, fresh):
        one.accumulate(other, rays, truth, how(200))
    torch.testing.assert_close(kernels.gradient(other), fresh.gradient(other))  # torch adds in any order


def test_memory_that_runs_out_leaves_no_buffers_of_the_wrong_size(monkeypatch: pytest.MonkeyPatch) -> None:
    old, new, rays, truth = some_grid(False), some_grid(False, (40, 40, 40)), some_rays(), torch.zeros(200, 3)
    kernels, zeros = CpuVoxels(2), torch.zeros
    kernels.accumulate(old, rays, truth, how(200))
    expected = kernels.gradient(old)
    kernels.forget()

    def full(*size: int) -> Tensor:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(torch, "zeros", full)
    with pytest.raises(RuntimeError, match="can't allocate"):
        kernels.accumulate(new, rays, truth, how(200))
    monkeypatch.setattr(torch, "zeros", zeros)
    kernels.forget()
    for grid in (new, old):
        kernels.accumulate(grid, rays, truth, how(200))
        assert kernels.gradient(grid).shape == grid.rows.shape
    assert torch.equal(kernels.gradient(old), expected)


@each_fast
def test_huge_densities_absorb_as_much_in_short_steps(make: Make) -> None:
    grid, rays = some_grid(False), some_rays()
    grid.rows[:, DENSITY] = 200.0
    march = how(200, step=0.02)
    torch.testing.assert_close(
        make().render(grid, rays, march), TorchVoxels().render(grid, rays, march), atol=1e-4, rtol=1e-4
    )


def test_buffers_stay_where_they_are_while_the_grid_has_the_same_size() -> None:
    """A second pair of them beside the first would be the most memory that training takes."""
    grid, rays, kernels = some_grid(False), some_rays(), CpuVoxels(2)
    kernels.accumulate(grid, rays, torch.zeros(200, 3), how(200))
    before = kernels._gradient.ctypes.data
    average = replace(grid, rows=grid.rows.clone())
    kernels.mark(average, rays, how(200), 0.01)
    kernels.accumulate(grid, rays, torch.zeros(200, 3), how(200))
    assert kernels._gradient.ctypes.data == before
