"""The constants of the paper's network and of its training, for all methods that use it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from nerf_core.common.configs import check_ranges, constant
from nerf_core.common.language import marked

PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class MlpConfig:
    """Defaults: the official configuration for Blender scenes (arXiv:2003.08934 and its code)."""

    rays: int = constant(1024, marked("rays per step"), least=1, most=2**22)
    # float32 cannot resolve a coordinate times 2³¹
    position_frequencies: int = constant(10, marked("frequencies of the encoding of positions, L in Eq. 4"), most=32)
    direction_frequencies: int = constant(4, marked("frequencies of the encoding of directions"), most=32)
    include_input: bool = constant(True, marked("whether the encoding keeps the bare coordinates too"))
    pi: bool = constant(
        False, marked("whether frequencies are multiples of pi, as in the paper, or of 1, as in its code")
    )
    view_directions: bool = constant(True, marked("whether colour depends on the direction of view"))
    depth: int = constant(8, marked("layers of the network"), least=1, most=64)
    width: int = constant(256, marked("units of a layer"), least=2, most=2**13)
    learning_rate: float = constant(5e-4, marked("Adam's learning rate at the first step"))
    decay: float = constant(
        0.1, marked("the learning rate falls to this share of itself over decay_steps"), share="(0, 1]"
    )
    decay_steps: int = constant(
        500_000,
        marked("steps of that decay; a run that is told its number of steps decays over those"),
        least=1,
        most=10**9,
    )
    total_steps: int = constant(
        500_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    adam_epsilon: float = constant(1e-7, marked("Adam's epsilon"))
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)
    last_delta: float = constant(
        1e10, marked("delta of the last sample, which makes any positive density there opaque")
    )
    precision: str = constant(
        "float32",
        marked("of matrix products; by default bfloat16 where the device is fast at it; part of what a seed fixes"),
        choices=PRECISIONS,
    )  # fmt: skip
    tile: int = constant(0, marked("rays rendered at once; 0: by device; part of what a seed fixes"), most=2**22)

    def __post_init__(self) -> None:
        check_ranges(self)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
