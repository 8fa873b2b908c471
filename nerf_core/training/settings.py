"""The settings of a run. They have the same names on both command lines, in the window and in config.json."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerf_core.datasets import LoadOptions


@dataclass(frozen=True)
class RunSettings:
    """How to load a capture and what to train on it.

    load: the options of loading.
    method: a name of `METHODS`; "auto" picks the default of the device.
    preset: a named set of the method's constants; see `Method.configure`.
    changes: constants that differ from the preset, as text by name.
    steps: the length of the learning schedule; 0: the method's own.
    seed: of everything random, 0 … 2⁶³ − 1.
    device: "cpu", "cuda" or "cuda:N"; "auto" picks one.
    threads: torch's threads on a CPU; 0: the cores that this process may use. They stay the same for the whole run,
        because the rounding of sums depends on them.
    """

    load: LoadOptions = field(default_factory=LoadOptions)
    method: str = "auto"
    preset: str = "auto"
    changes: dict[str, str] = field(default_factory=dict)
    steps: int = 0
    seed: int = 0
    device: str = "auto"
    threads: int = 0
