"""The constants of the paper's method, their official values, and presets that change a few of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, constant, restored
from nerf_core.common.device import fast_precision
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene
from nerf_core.methods.mlp.config import MlpConfig


@dataclass(frozen=True)
class NerfConfig(MlpConfig):
    """The paper's network and its placement of samples, with the official values for Blender scenes."""

    coarse_samples: int = constant(64, marked("samples per ray of the coarse network, N_c"), least=3, most=2**14)
    fine_samples: int = constant(
        128, marked("samples per ray that the coarse weights place, N_f; 0: no fine network"), most=2**14
    )
    density_noise: float = constant(0.0, marked("standard deviation of noise on the raw density in training"))
    one_image: bool = constant(True, marked("whether all rays of a step come from one photo"))
    precrop_steps: int = constant(
        0, marked("first steps in which rays come from the middle of photos alone"), most=10**9
    )
    precrop: float = constant(0.5, marked("the share of a photo's side that this middle has"), share="(0, 1]")
    chunk_rays: int = constant(
        32, marked("rays whose gradient is computed at once; part of what a seed fixes"), least=1, most=2**22
    )

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> NerfConfig:
        """Start with the official values for this kind of scene, then apply the preset, then `changes`."""
        config = NerfConfig()
        if not scene.synthetic:
            # LLFF's official configuration; there is none for other captures of real photos
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


# The rows of the ablation table (NeRF, table 2). Each differs from the complete model only in what its name says.
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
    # Not a row of the table: the same method made smaller, for machines that trace only hundreds of rays a second with
    # the complete model. In the first minutes many small steps over all photos help most; half the width and fewer
    # samples allow three times as many steps.
    "quick": {
        "width": 128, "coarse_samples": 24, "fine_samples": 32, "rays": 64, "chunk_rays": 64, "one_image": False,
        "learning_rate": 1.5e-3,
        "precrop_steps": 100, "density_noise": 0.0, "total_steps": 60_000, "decay_steps": 60_000,
    },
}  # fmt: skip


def preset_name(preset: str, device: torch.device) -> str:
    """Replace `auto` by "complete" on CUDA and by "quick" on a CPU, where the official batch takes seconds a step."""
    if preset == "auto":
        return "complete" if device.type == "cuda" else "quick"
    if preset not in PRESETS:
        raise UserError(f"--preset {shorten(preset)}: choose one of auto, {', '.join(PRESETS)}")
    return preset
