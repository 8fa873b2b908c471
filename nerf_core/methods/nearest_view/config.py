"""The constants of the nearest photo: which photos there are to choose from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene


@dataclass(frozen=True)
class NearestViewConfig:
    """The photos to choose from. There is nothing else to set."""

    train_images: int = constant(0, marked("training photos to choose from, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def total_steps(self) -> int:
        """0: there is nothing to train."""
        return 0

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> NearestViewConfig:
        """Apply `changes`. The method is the same for every scene and device."""
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method nearest-view has none but auto")
        return changed(NearestViewConfig(), changes, "nearest-view")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> NearestViewConfig:
        return restored(NearestViewConfig, config, "nearest-view")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
