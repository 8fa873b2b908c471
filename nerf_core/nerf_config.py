"""Every constant of the paper's method, its official values, and the presets that change a few of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.constants import changed, check_ranges, restored
from nerf_core.device import fast_precision
from nerf_core.errors import UserError, shorten
from nerf_core.scene import Scene

# 2³¹ times a coordinate is past what float32 can tell apart; the other limits are past what any machine can hold.
MOST = {
    "position_frequencies": 32, "direction_frequencies": 32, "rays": 2**22, "chunk_rays": 2**22, "tile": 2**22,
    "coarse_samples": 2**14, "fine_samples": 2**14, "depth": 64, "width": 2**13, "decay_steps": 10**9,
    "total_steps": 10**9, "precrop_steps": 10**9, "train_images": 10**9,
}  # fmt: skip
PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class NerfConfig:
    """Defaults: the official configuration for Blender scenes (arXiv:2003.08934 and its code).

    decay_steps: the learning rate falls to `decay` of itself over so many steps; a run that is told its number of
    steps decays over those instead. one_image: each step's rays come from one photo. precrop_steps: so long,
    rays come from the middle `precrop` of a photo. train_images: only so many photos, evenly spread (0: all).
    last_delta: the δ of the last sample, which makes any positive density there opaque. precision: of the matrix
    products; unless it is set, bfloat16 where the device is fast at that. chunk_rays: rays whose gradient is computed
    at once; tile: rays rendered at once (0: by device). All three are part of what a seed fixes.
    """

    rays: int = 1024
    coarse_samples: int = 64
    fine_samples: int = 128
    position_frequencies: int = 10
    direction_frequencies: int = 4
    include_input: bool = True
    pi: bool = False
    view_directions: bool = True
    depth: int = 8
    width: int = 256
    learning_rate: float = 5e-4
    decay: float = 0.1
    decay_steps: int = 500_000
    total_steps: int = 500_000
    adam_epsilon: float = 1e-7
    density_noise: float = 0.0
    one_image: bool = True
    precrop_steps: int = 0
    precrop: float = 0.5
    train_images: int = 0
    last_delta: float = 1e10
    precision: str = "float32"
    chunk_rays: int = 32
    tile: int = 0

    def __post_init__(self) -> None:
        least = {
            "rays": 1,
            "coarse_samples": 3,
            "depth": 1,
            "width": 2,
            "decay_steps": 1,
            "total_steps": 1,
            "chunk_rays": 1,
        }
        check_ranges(self, least, MOST)
        if self.precision not in PRECISIONS:
            raise UserError(f"--set precision={shorten(self.precision)}: choose {' or '.join(PRECISIONS)}")
        if not 0 < self.precrop <= 1:
            raise UserError(f"--set precrop={self.precrop}: must lie in (0, 1]")
        if not 0 < self.decay <= 1:
            raise UserError(f"--set decay={self.decay}: must lie in (0, 1]")

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> NerfConfig:
        """Official values for this kind of scene, then the preset's, then `changes` ({"rays": "256"})."""
        config = NerfConfig()
        if not scene.synthetic:
            # LLFF's official configuration; other captures of real photos have none of their own
            config = replace(
                config, rays=4096, one_image=False, decay_steps=250_000, total_steps=200_000, density_noise=1.0
            )
        if device.type == "cuda":
            config = replace(config, chunk_rays=4096)
        config = replace(config, precision=fast_precision(device))
        return changed(replace(config, **PRESETS[preset_name(preset, device)]), changes, "nerf")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> NerfConfig:
        return restored(NerfConfig, config, "nerf")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


# The rows of the ablation table (NeRF, table 2) differ from the complete model in nothing but what they say.
PRESETS: dict[str, dict[str, Any]] = {
    "complete": {},
    "no-pe-viewdirs-hierarchy": {
        "position_frequencies": 0, "view_directions": False, "coarse_samples": 256, "fine_samples": 0,
    },
    "no-pe": {"position_frequencies": 0, "direction_frequencies": 0},
    "no-viewdirs": {"view_directions": False},
    "no-hierarchy": {"coarse_samples": 256, "fine_samples": 0},
    "far-fewer-images": {"train_images": 25},
    "fewer-images": {"train_images": 50},
    "fewer-frequencies": {"position_frequencies": 5, "direction_frequencies": 2},
    "more-frequencies": {"position_frequencies": 15, "direction_frequencies": 6},
    # Not of the table: the same method, smaller, where a machine does hundreds of rays a second of the whole model.
    # In its first minutes it gains most from many small steps over all photos; half the width and fewer samples give
    # three times as many.
    "quick": {
        "width": 128, "coarse_samples": 24, "fine_samples": 32, "rays": 64, "chunk_rays": 64, "one_image": False,
        "learning_rate": 1.5e-3,
        "precrop_steps": 100, "density_noise": 0.0, "total_steps": 60_000, "decay_steps": 60_000,
    },
}  # fmt: skip


def preset_name(preset: str, device: torch.device) -> str:
    """`auto` is "complete" on CUDA and "quick" on a CPU, where the official batch takes seconds a step."""
    if preset == "auto":
        return "complete" if device.type == "cuda" else "quick"
    if preset not in PRESETS:
        raise UserError(f"--preset {shorten(preset)}: choose one of auto, {', '.join(PRESETS)}")
    return preset
