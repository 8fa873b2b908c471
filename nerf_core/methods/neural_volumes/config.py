"""The constants of Neural Volumes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene

WARPS = ("affine", "field", "none")


@dataclass(frozen=True)
class NeuralVolumesConfig:
    """The paper's volume and warp (arXiv:1906.07751), which suit CUDA. `configure` makes them smaller for a CPU."""

    template: int = constant(128, marked("voxels along a side of the template; a power of two"), least=4, most=256)
    width: int = constant(
        1024, marked("channels of the decoder's first layer; they halve at every second"), least=8, most=2048
    )
    latent: int = constant(256, marked("numbers of the latent code"), least=1, most=4096)
    warp: str = constant(
        "affine", marked("the inverse warp: a mixture of affine warps, a field, or none"), choices=WARPS
    )
    warps: int = constant(16, marked("affine warps in the mixture, K"), least=1, most=32)
    warp_cells: int = constant(32, marked("voxels along a side of the warp; a power of two"), least=2, most=32)
    step: float = constant(0.5, marked("length of a sample, in voxels of the template"), least=0.1, most=8)
    tv_weight: float = constant(0.01, marked("weight of the total variation of the log opacity; 0: off"))
    # ten times as much empties the demo scene before anything is learnt
    opacity_prior: float = constant(0.001, marked("weight of the prior that a pixel is opaque or empty; 0: off"))
    rays: int = constant(4096, marked("rays per step"), least=1, most=2**20)
    chunk: int = constant(
        2**20, marked("samples whose gradient is computed at once; part of what a seed fixes"), least=1
    )
    learning_rate: float = constant(1e-3, marked("Adam's learning rate, falling as 1 / (1 + step / slowdown)"))
    slowdown: float = constant(3000.0, marked("steps after which the learning rate has halved"), least=1)
    total_steps: int = constant(
        20_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, value in (("template", self.template), ("warp_cells", self.warp_cells)):
            if value & (value - 1):
                raise UserError(f"--set {name}={value}: must be a power of two, because every layer doubles it")

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> NeuralVolumesConfig:
        """Return the paper's sizes on CUDA; on a CPU, an eighth of the voxels and a quarter of the channels."""
        if preset != "auto":
            raise UserError(
                f"--preset {shorten(preset)}: method neural-volumes has none but auto; change constants with --set"
            )
        config = NeuralVolumesConfig()
        if device.type == "cpu":
            config = replace(config, template=64, width=256, warp_cells=16, step=1.0, chunk=2**15)
        return changed(config, changes, "neural-volumes")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> NeuralVolumesConfig:
        return restored(NeuralVolumesConfig, config, "neural-volumes")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
