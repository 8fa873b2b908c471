"""What a run is made of: the same words on both command lines, in the window and in config.json."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerf_core.datasets import LoadOptions


@dataclass(frozen=True)
class RunSettings:
    """How to load a capture and what to train on it.

    method: auto picks the default of the device. preset, changes: the method's configuration; see `Method.configure`.
    steps: length of the learning schedule; 0: the method's own fixed number.
    threads: of torch on a CPU; 0: the cores this process may use. Fixed after the start, since sums depend on it.
    """

    load: LoadOptions = field(default_factory=LoadOptions)
    method: str = "auto"
    preset: str = "auto"
    changes: dict[str, str] = field(default_factory=dict)
    steps: int = 0
    seed: int = 0
    device: str = "auto"
    threads: int = 0
