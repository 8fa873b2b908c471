"""Learn which cells are occupied from the density that a field has in them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.volume.cells import Cells

FEW = 1 << 15  # cells in one update, unless all are updated


class Occupancy:
    """An estimate of the optical depth in every cell, and the cells that it makes occupied.

    absorbed: (x, y, z), the largest optical depth that one sample had in a cell, multiplied by `decay` at each update.
    A cell is occupied if its value is above `empty` or above the mean of all cells, whichever is lower. The mean keeps
    the denser cells while the whole field is still thin fog (instant-ngp, appendix C, arXiv:2201.05989).
    """

    def __init__(self, cells: Cells, empty: float, decay: float) -> None:
        self.cells, self.empty, self.decay = cells, empty, decay
        self.absorbed = torch.zeros(cells.size, device=cells.kinds.device)

    def update(self, tau: Callable[[Tensor], Tensor], everywhere: bool, generator: torch.Generator) -> None:
        """Sample the field at a random point of each chosen cell, and decide anew which cells are occupied.

        tau: points (P, 3) in [0, 1] → optical depth (P,) of one sample there.
        everywhere: choose all cells. Otherwise FEW are drawn, half of them among the occupied ones.
        generator: the source of the random numbers.
        """
        total = self.absorbed.numel()
        if everywhere or total <= FEW:
            chosen = torch.arange(total)
        else:
            occupied = self.cells.kinds.flatten().nonzero()[:, 0].cpu()
            some = torch.randint(total, (FEW // 2,), generator=generator)
            if len(occupied):
                some = torch.cat([some, occupied[torch.randint(len(occupied), (FEW // 2,), generator=generator)]])
            chosen = some.unique()
        _, y, z = self.cells.size
        cell = torch.stack([chosen // (y * z), chosen // z % y, chosen % z], -1)
        within = torch.rand(len(chosen), 3, generator=generator)
        points = ((cell + within) / torch.tensor(self.cells.size)).to(self.absorbed.device)
        flat, chosen = self.absorbed.view(-1), chosen.to(self.absorbed.device)
        for start in range(0, len(chosen), FEW):
            part = chosen[start : start + FEW]
            flat[part] = torch.maximum(flat[part] * self.decay, tau(points[start : start + FEW]))
        self.apply()

    def apply(self) -> None:
        """Decide which cells are occupied, from `absorbed`."""
        occupied = self.absorbed > torch.clamp(self.absorbed.mean(), max=self.empty)
        if not bool(occupied.any()):
            occupied = torch.ones_like(occupied)
        c = self.cells
        self.cells = Cells.of(c.origin, c.voxel, occupied, c.contracted)


def softened(raw: Tensor) -> Tensor:
    """trunc_exp: the density e^raw, with raw limited to [−15, 11].

    e¹¹ ≈ 60,000 makes a sample opaque whatever its length, so that larger values would change nothing.
    """
    return torch.exp(functional.hardtanh(raw, -15.0, 11.0))
