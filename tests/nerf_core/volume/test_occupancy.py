"""Which cells count as empty."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.volume.cells import Cells
from nerf_core.volume.occupancy import Occupancy, softened


def occupancy(size: int = 8) -> Occupancy:
    everything = torch.ones(size, size, size, dtype=torch.bool)
    return Occupancy(Cells.of(np.full(3, -1.0), np.full(3, 2 / size), everything, contracted=False), 0.01, 0.5)


def left_half(x: Tensor) -> Tensor:
    return torch.where(x[:, 0] < 0.5, 1.0, 0.0)


def test_cells_that_absorb_stay_and_the_others_go() -> None:
    o, g = occupancy(), torch.Generator().manual_seed(0)
    o.update(left_half, everywhere=True, generator=g)
    assert o.cells.occupied[:4].all()
    assert not o.cells.occupied[4:].any()
    assert o.cells.leap[1, 0, 0] == 1


def test_cells_that_no_longer_absorb_fade() -> None:
    o, g = occupancy(), torch.Generator().manual_seed(0)
    o.update(left_half, everywhere=True, generator=g)
    for _ in range(12):
        o.update(lambda x: torch.where(x[:, 0] > 0.9, 1.0, 0.0), everywhere=True, generator=g)
    assert not o.cells.occupied[:4].any()
    assert o.cells.occupied[7].all()


def test_the_denser_half_of_an_even_fog_stays_and_all_of_empty_space() -> None:
    o, g = occupancy(), torch.Generator().manual_seed(0)
    o.update(lambda x: 1e-4 + 1e-6 * x[:, 0], everywhere=True, generator=g)
    assert 0.3 < float(o.cells.occupied.float().mean()) < 0.7  # the cells above the mean: half of a linear fog
    o = occupancy()
    o.update(lambda x: torch.zeros(len(x)), everywhere=True, generator=g)
    assert o.cells.occupied.all()


def test_a_large_grid_is_updated_in_parts() -> None:
    o, g = occupancy(64), torch.Generator().manual_seed(0)
    looked: list[int] = []

    def count(x: Tensor) -> Tensor:
        looked.append(len(x))
        return left_half(x)

    o.update(count, everywhere=False, generator=g)
    assert 16_000 < sum(looked) <= 32_768
    for _ in range(80):
        o.update(left_half, everywhere=False, generator=g)
    right = o.cells.occupied[:32].float().mean(), o.cells.occupied[32:].float().mean()
    assert right[0] > 0.95
    assert right[1] == 0


def test_density_stays_finite() -> None:
    assert softened(torch.tensor([-1e9, 0.0, 1e9])).isfinite().all()
