"""The constants of the hash-grid method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.geometry.scene import Scene

MOST = {
    "samples": 2**22, "most_rays": 2**18, "levels": 32, "features": 8, "log2_rows": 24, "coarsest": 256,
    "finest": 2**16, "hidden": 512, "cells": 256, "update_every": 10**6, "warm_updates": 10**6, "total_steps": 10**9,
    "train_images": 10**9,
}  # fmt: skip
LEAST = {
    "samples": 1, "most_rays": 1, "levels": 1, "features": 1, "log2_rows": 4, "coarsest": 2, "hidden": 1, "cells": 4,
    "update_every": 1, "total_steps": 1, "pixels": 0.05, "slowdown": 1,
}  # fmt: skip
MOST_FEATURES = 2**28  # 1 GiB, and as much again for the gradient, each moment and the average


@dataclass(frozen=True)
class HashConfig:
    """samples: about so many a step; the number of rays, at most most_rays, follows from how many each one needs.

    levels, features, log2_rows: of the hash grid (L, F, log₂ T). coarsest: cells a side of its first level; finest: of
    its last (0: one pixel of a photo at the scene's centre). hidden: width of the two networks. pixels: length of a
    sample, in such pixels. cells: of the occupancy grid, a side; update_every, warm_updates: how often it is looked at,
    and how many times all of it at first; empty: what a cell must absorb along a sample to count; decay: of what was
    once seen in it. learning_rate: Adam's, falling as 1/(1 + step/slowdown).
    """

    samples: int = 2**18
    most_rays: int = 2**15
    levels: int = 16
    features: int = 2
    log2_rows: int = 19
    coarsest: int = 16
    finest: int = 0
    hidden: int = 64
    pixels: float = 1.0
    cells: int = 128
    update_every: int = 16
    warm_updates: int = 16
    empty: float = 0.01
    decay: float = 0.95
    learning_rate: float = 1e-2
    slowdown: float = 3000.0
    total_steps: int = 30_000
    train_images: int = 0

    def __post_init__(self) -> None:
        check_ranges(self, LEAST, MOST)
        for name in ("empty", "decay"):
            if not 0 < getattr(self, name) < 1:
                raise UserError(f"--set {name}={getattr(self, name)}: must lie between 0 and 1")

        if self.features & (self.features - 1):
            raise UserError(f"--set features={self.features}: must be 1, 2, 4 or 8")
        if self.levels * self.features << self.log2_rows > MOST_FEATURES:
            raise UserError(
                f"--set levels={self.levels}, features={self.features}, log2_rows={self.log2_rows}: a table of "
                f"{self.levels * self.features << self.log2_rows:,} numbers; at most {MOST_FEATURES:,}"
            )

    @property
    def rays(self) -> int:
        return self.most_rays

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> HashConfig:
        """The paper's constants on CUDA; fewer levels of a smaller table, and smaller batches, on a CPU."""
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
