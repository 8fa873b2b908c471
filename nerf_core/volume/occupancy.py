"""Which cells may hold something, learnt from the density that a field has had in them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.volume.cells import Cells, leaps

FEW = 1 << 15  # cells looked at once, where not all are


class Occupancy:
    """absorbed: (x, y, z) the optical depth that one sample would have in a cell, as last seen, decaying.

    A cell is taken for occupied when that is above `empty`, or above the mean of all: of a fog in which nothing stands
    out yet the denser half stays (instant-ngp, appendix C, arXiv:2201.05989).
    """

    def __init__(self, cells: Cells, empty: float, decay: float) -> None:
        self.cells, self.empty, self.decay = cells, empty, decay
        self.absorbed = torch.zeros(cells.size, device=cells.occupied.device)

    def update(self, tau: Callable[[Tensor], Tensor], everywhere: bool, generator: torch.Generator) -> None:
        """Look at a random point in each cell, or of FEW random ones, half of them occupied.

        tau: points (P, 3) in [0, 1] → optical depth (P,) of one sample there.
        """
        total = self.absorbed.numel()
        if everywhere or total <= FEW:
            chosen = torch.arange(total)
        else:
            occupied = self.cells.occupied.flatten().nonzero()[:, 0].cpu()
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
        """Cells from what they have absorbed."""
        occupied = self.absorbed > torch.clamp(self.absorbed.mean(), max=self.empty)
        if not bool(occupied.any()):
            occupied = torch.ones_like(occupied)
        c = self.cells
        self.cells = Cells(c.size, c.origin, c.voxel, c.contracted, occupied, leaps(occupied))


def softened(raw: Tensor) -> Tensor:
    """e^raw, a density, whose exponent stops growing at 11: beyond, a sample is opaque whatever its length."""
    return torch.exp(functional.hardtanh(raw, -15.0, 11.0))
