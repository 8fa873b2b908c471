"""The constants of Scene Representation Networks for a single scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.device import fast_precision
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene

PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class SrnConfig:
    """The paper's networks and losses (arXiv:1906.01618), and a training schedule for minutes on a CPU.

    The networks' sizes, the ten steps and the two terms of the loss are the paper's. `depth_weight` is that of its
    released code: 10 beside 200 times the squared error of colours in [−1, 1], which is 800 times that of colours in
    [0, 1]. The schedule is not: the code takes 4e-5 for 200,000 steps of whole pictures, without a decay.
    """

    march_steps: int = constant(10, marked("steps of the ray marcher"), least=1, most=256)
    start: float = constant(
        1.0, marked("distance where the marcher starts, as a share of the scene's near bound"), share="(0, 1]"
    )
    layers: int = constant(4, marked("layers of the scene network Φ"), least=1, most=16)
    generator_layers: int = constant(
        5, marked("layers of the pixel generator before its linear output"), least=1, most=16
    )
    width: int = constant(256, marked("units of a layer, and features of a point"), least=2, most=2**11)
    hidden: int = constant(16, marked("hidden units of the marcher's LSTM"), least=1, most=2**11)
    depth_weight: float = constant(
        0.0125, marked("weight of the depth regulariser beside the squared error of the colours")
    )
    rays: int = constant(256, marked("rays per step"), least=1, most=2**22)
    learning_rate: float = constant(1e-3, marked("Adam's learning rate at the first step"))
    decay: float = constant(0.1, marked("the learning rate falls to this share of itself over the run"), share="(0, 1]")
    total_steps: int = constant(
        12_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    adam_epsilon: float = constant(1e-8, marked("Adam's epsilon"))
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)
    chunk_rays: int = constant(
        256, marked("rays whose gradient is computed at once; part of what a seed fixes"), least=1, most=2**22
    )
    precision: str = constant(
        "float32",
        marked("of matrix products; by default bfloat16 where the device is fast at it; part of what a seed fixes"),
        choices=PRECISIONS,
    )  # fmt: skip
    tile: int = constant(0, marked("rays rendered at once; 0: by device; part of what a seed fixes"), most=2**22)

    def __post_init__(self) -> None:
        check_ranges(self)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> SrnConfig:
        """Return the constants for this device, then apply `changes`."""
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method srn has none but auto; change constants with --set")
        config = SrnConfig(precision=fast_precision(device))
        if device.type == "cuda":
            config = replace(config, rays=4096, chunk_rays=4096, total_steps=100_000)
        return changed(config, changes, "srn")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> SrnConfig:
        return restored(SrnConfig, config, "srn")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
