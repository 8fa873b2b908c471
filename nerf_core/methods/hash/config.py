"""The constants of the hash-grid method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene

MOST_FEATURES = 2**28  # 1 GiB, and the same again for the gradient, for each moment and for the EMA


@dataclass(frozen=True)
class HashConfig:
    """The paper's constants (arXiv:2201.05989), which suit CUDA. `configure` makes them smaller for a CPU."""

    samples: int = constant(2**18, marked("samples per step, about; the number of rays follows"), least=1, most=2**22)
    most_rays: int = constant(2**15, marked("most rays per step"), least=1, most=2**18)
    levels: int = constant(16, marked("levels of the hash grid, L"), least=1, most=32)
    features: int = constant(2, marked("features per vertex and level, F; a power of two"), least=1, most=8)
    log2_rows: int = constant(19, marked("logarithm of the rows of a level's table, log2 T"), least=4, most=24)
    coarsest: int = constant(16, marked("cells along a side of the first level, N_min"), least=2, most=256)
    finest: int = constant(
        0,
        marked("cells along a side of the last level, N_max; 0: one per pixel of a photo at the scene's centre"),
        most=2**16,
    )
    hidden: int = constant(64, marked("units of the hidden layers of both networks"), least=1, most=512)
    pixels: float = constant(1.0, marked("length of a sample, in pixels of a photo at the scene's centre"), least=0.05)
    cells: int = constant(128, marked("cells along a side of the occupancy grid"), least=4, most=256)
    update_every: int = constant(16, marked("steps between updates of the occupancy grid"), least=1, most=10**6)
    warm_updates: int = constant(16, marked("first updates that look at all of it"), most=10**6)
    empty: float = constant(
        0.01, marked("opacity that a cell must have along a sample to count as occupied"), share="(0, 1)"
    )
    decay: float = constant(0.95, marked("share of a cell's last known density that an update keeps"), share="(0, 1)")
    learning_rate: float = constant(1e-2, marked("Adam's learning rate, falling as 1 / (1 + step / slowdown)"))
    slowdown: float = constant(3000.0, marked("steps after which the learning rate has halved"), least=1)
    total_steps: int = constant(
        30_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.features & (self.features - 1):
            raise UserError(f"--set features={self.features}: must be 1, 2, 4 or 8")
        if self.levels * self.features << self.log2_rows > MOST_FEATURES:
            raise UserError(
                f"--set levels={self.levels}, features={self.features}, log2_rows={self.log2_rows}: a table of "
                f"{self.levels * self.features << self.log2_rows:,} numbers; at most {MOST_FEATURES:,}"
            )

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> HashConfig:
        """Return the paper's constants on CUDA; on a CPU, fewer levels, a smaller table and smaller batches."""
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method hash has none but auto; change constants with --set")
        config = HashConfig()
        if device.type == "cpu":
            config = replace(
                config,
                samples=2**13,
                most_rays=2**13,
                levels=8,
                features=4,
                log2_rows=16,
                hidden=32,
                cells=64,
                slowdown=1000.0,
            )
        return changed(config, changes, "hash")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> HashConfig:
        return restored(HashConfig, config, "hash")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
