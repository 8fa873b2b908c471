"""The constants of the paper's network and of its training, whatever places its samples."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from nerf_core.common.configs import check_ranges
from nerf_core.common.errors import UserError, shorten

# 2³¹ times a coordinate is past what float32 can tell apart; the other limits are past what any machine can hold.
MOST = {
    "position_frequencies": 32, "direction_frequencies": 32, "rays": 2**22, "tile": 2**22, "depth": 64,
    "width": 2**13, "decay_steps": 10**9, "total_steps": 10**9, "train_images": 10**9,
}  # fmt: skip
LEAST = {"rays": 1, "depth": 1, "width": 2, "decay_steps": 1, "total_steps": 1}
PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class MlpConfig:
    """Defaults: the official configuration for Blender scenes (arXiv:2003.08934 and its code).

    rays: of a step. decay_steps: the learning rate falls to `decay` of itself over so many steps; a run that is told
    its number of steps decays over those instead. train_images: only so many photos, evenly spread (0: all).
    last_delta: the δ of the last sample, which makes any positive density there opaque. precision: of the matrix
    products; unless it is set, bfloat16 where the device is fast at that. tile: rays rendered at once (0: by device).
    Both are part of what a seed fixes.
    """

    rays: int = 1024
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
    train_images: int = 0
    last_delta: float = 1e10
    precision: str = "float32"
    tile: int = 0

    def __post_init__(self) -> None:
        check_ranges(self, LEAST, MOST)
        if self.precision not in PRECISIONS:
            raise UserError(f"--set precision={shorten(self.precision)}: choose {' or '.join(PRECISIONS)}")
        if not 0 < self.decay <= 1:
            raise UserError(f"--set decay={self.decay}: must lie in (0, 1]")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
