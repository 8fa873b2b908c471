"""The constants of the voxel method, and how fine its grid becomes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.geometry.scene import Scene

MOST = {
    "rays": 2**22, "first_rays": 2**22, "start": 256, "resolution": 1024, "planes": 1024, "level_steps": 10**6,
    "prune_every": 10**6, "total_steps": 10**9, "train_images": 10**9, "most_rows": 2**26,
    "growth": 16, "pixels": 10_000, "step": 16,
}  # fmt: skip
LEAST = {
    "rays": 1, "first_rays": 1, "start": 4, "planes": 4, "level_steps": 1, "prune_every": 1, "total_steps": 1,
    "most_rows": 64, "resolution": 1, "step": 0.05, "growth": 1.05, "pixels": 0.05, "epsilon": 1e-12, "slowdown": 1,
}  # fmt: skip


@dataclass(frozen=True)
class VoxelConfig:
    """rays a step; first_rays in the first level, where nothing is known to be empty yet.

    start: cells along the box's longest side in the first level. pixels: side of the finest cells, in pixels of a photo
    at the scene's centre, unless that takes more than `resolution` cells a side. planes: cells in depth under NDC.
    growth: levels are so many times finer than the one before. level_steps: steps of the first level; each further one
    has `growth` times as many, the last all the rest. most_rows: vertices stored at most, 192 bytes each and 64
    more a thread.
    step: length of a sample in cells. bias: raw density of a new grid. rate_*: Adam's, falling as 1/(1 + s/slowdown) in
    a level's step s; keep, keep_square: β₁, β₂; epsilon in units of one ray's gradient. smoothness: of density.
    average: pictures show a mean over about the last 1/(1 − average) steps of a row, fewer while a level is young.
    prune: a cell is dropped when no sample near it has weighed as much lately; looked at when a level ends, in the last
    every `prune_every` steps.
    """

    rays: int = 12288
    first_rays: int = 4096
    start: int = 40
    pixels: float = 0.8
    resolution: int = 400
    planes: int = 128
    growth: float = 1.7
    level_steps: int = 40
    most_rows: int = 3_000_000
    step: float = 0.7
    bias: float = -3.0
    rate_color: float = 0.2
    rate_density: float = 0.3
    slowdown: float = 400.0
    keep: float = 0.9
    keep_square: float = 0.99
    epsilon: float = 1e-4
    average: float = 0.98
    smoothness: float = 2.5e-6
    prune: float = 0.05
    prune_every: int = 400
    total_steps: int = 30_000
    train_images: int = 0

    def __post_init__(self) -> None:
        check_ranges(self, LEAST, MOST)
        for name in ("keep", "keep_square", "average"):
            if not 0 <= getattr(self, name) < 1:
                raise UserError(f"--set {name}={getattr(self, name)}: must lie in [0, 1)")

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> VoxelConfig:
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method voxels has none but auto; change constants with --set")
        config = VoxelConfig()
        if not scene.synthetic:  # places fill the space that an object leaves empty, and fewer rays tell about a part
            config = replace(config, prune=0.02, smoothness=1e-4, step=1.0)
        return changed(config, changes, "voxels")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> VoxelConfig:
        return restored(VoxelConfig, config, "voxels")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
