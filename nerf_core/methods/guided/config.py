"""The constants of the guided method: those of the paper's network and of its proposal grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, constant, restored
from nerf_core.common.device import fast_precision
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene
from nerf_core.methods.mlp.config import MlpConfig
from nerf_core.methods.voxels.config import VoxelConfig

GUIDE = "guide."  # prefix of the proposal grid's constants, as in --set guide.step=0.5
# The proposal grid has a few hundred steps: too few for the finest grids, for which objects wait longer than that.
QUICK = {"resolution": "400", "wait": "0", "most_rays": "12288"}


@dataclass(frozen=True)
class GuidedConfig(MlpConfig):
    """The paper's network with a proposal grid of its own constants, guide.NAME.

    As configured, training differs from the paper's: a higher learning rate, which decays over fewer steps, and fewer
    rays per step on a CPU. `total_steps` counts the proposal grid's steps too.
    """

    guide_steps: int = constant(
        500, marked("steps of the proposal grid, before the network's first"), least=1, most=10**6
    )
    least: float = constant(
        0.01, marked("weight above which a sample of the proposal grid is put to the network"), most=0.5
    )
    guide: VoxelConfig = field(default_factory=VoxelConfig)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> GuidedConfig:
        if preset != "auto":
            raise UserError(
                f"--preset {shorten(preset)}: method nerf-guided has none but auto; change constants with --set"
            )
        config = GuidedConfig(
            rays=4096 if device.type == "cuda" else 512, learning_rate=1e-3, decay_steps=30_000, total_steps=30_000,
            precision=fast_precision(device),
        )  # fmt: skip
        own = {name: text for name, text in changes.items() if not name.startswith(GUIDE)}
        guides = {name.removeprefix(GUIDE): text for name, text in changes.items() if name.startswith(GUIDE)}
        config = changed(config, own, "nerf-guided")
        # the trainer draws the pixels of both from the same photos
        same = {"train_images": str(config.train_images)}
        return replace(config, guide=VoxelConfig.configure(scene, "auto", QUICK | same | guides, device))

    @staticmethod
    def restore(config: Mapping[str, Any]) -> GuidedConfig:
        guide = config.get("guide")
        if not isinstance(guide, Mapping):
            raise UserError("the checkpoint's nerf-guided configuration has no guide: made by another version")
        return restored(GuidedConfig, {**config, "guide": VoxelConfig.restore(guide)}, "nerf-guided")
