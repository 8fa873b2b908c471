"""The constants of the RGBα grid, and the levels of its grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene

LEAST, MOST = 2, 512


@dataclass(frozen=True)
class GridConfig:
    """The grid of `side`³ vertices is reached in levels: the first has at most `coarsest` a side, each next one twice
    as many."""

    side: int = constant(
        128,
        marked("vertices along a side of the grid, N; it takes 16 N³ bytes, and in training 64 N³"),
        least=LEAST,
        most=MOST,
    )
    rays: int = constant(4096, marked("rays per step"), least=1, most=2**20)
    step: float = constant(0.75, marked("length of a sample in cells"), least=0.05, most=16)
    coarsest: int = constant(32, marked("most vertices along a side in the first level"), least=LEAST, most=MOST)
    level_steps: int = constant(
        200,
        marked("steps of the first level; each further one has twice as many, the last all the rest"),
        least=1,
        most=10**6,
    )
    fog: float = constant(0.002, marked("opacity of a cell of the first level at the start"), share="(0, 1)")
    empty: float = constant(0.005, marked("opacity that a cell must have to be occupied"), share="(0, 1)")
    update_every: int = constant(
        50, marked("steps of a level between two looks at which cells are occupied"), least=1, most=10**6
    )
    smoothness: float = constant(
        3e-6,
        marked("weight of the squared differences between neighbouring vertices, in units of a ray's squared error"),
    )
    learning_rate: float = constant(0.2, marked("Adam's learning rate, falling as 1 / (1 + step / slowdown)"))
    slowdown: float = constant(300.0, marked("steps after which the learning rate has halved"), least=1)
    total_steps: int = constant(
        30_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def volume_bytes(self) -> int:
        """The memory of the grid itself: N³ vertices of 4 float32."""
        return 16 * self.side**3

    def sides(self) -> tuple[int, ...]:
        """The vertices along a side in each level. Each is half of the next, rounded up."""
        found = [self.side]
        while found[0] > self.coarsest:
            found.insert(0, (found[0] + 1) // 2)
        return tuple(found)

    def level_at(self, step: int) -> int:
        """The level of a training step. Level l begins at `level_steps` · (2ˡ − 1)."""
        return min((step // self.level_steps + 1).bit_length() - 1, len(self.sides()) - 1)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> GridConfig:
        if preset != "auto":
            raise UserError(
                f"--preset {shorten(preset)}: method rgba-grid has none but auto; change constants with --set"
            )
        return changed(GridConfig(), changes, "rgba-grid")

    @staticmethod
    def restore(config: Mapping[str, Any]) -> GridConfig:
        return restored(GridConfig, config, "rgba-grid")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
