"""The settings of a run. They have the same names on both command lines, in the window and in config.json."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypeVar

from nerf_core.common.json_files import Fields
from nerf_core.datasets import LoadOptions

T = TypeVar("T")
ADDED: dict[str, str | bool] = {
    "exposure": "off",
    "lens": "perspective",
    "poses": "normal",
    "refine_poses": False,
}  # fields that files of earlier versions lack, and what those versions did


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
    exposure: "on", "off" or "auto": whether each training photo has an exposure of its own that is learnt; see
        `nerf_core.training.exposure`.
    refine_poses: whether the poses of training photos are corrected; see `nerf_core.training.pose_refinement`.
    """

    load: LoadOptions = field(default_factory=LoadOptions)
    method: str = "auto"
    preset: str = "auto"
    changes: dict[str, str] = field(default_factory=dict)
    steps: int = 0
    seed: int = 0
    device: str = "auto"
    threads: int = 0
    exposure: str = "auto"
    refine_poses: bool = False


def filled(kind: type[T], values: Fields) -> T:
    """Make a dataclass of settings from a JSON object.

    Args:
        kind: `RunSettings` or `LoadOptions`.
        values: a value for every field, and nothing else. A field of ADDED may be missing.

    Raises:
        UserError: a value has another type than its default, is missing, or has a name that is no field.
    """
    defaults = kind()
    known = {f.name for f in fields(kind)}  # pyright: ignore[reportArgumentType]: T is one of two dataclasses
    given = {name: value for name, value in ADDED.items() if name in known} | values.values
    for f in fields(kind):  # pyright: ignore[reportArgumentType]: T is one of two dataclasses
        default, value = getattr(defaults, f.name), given.get(f.name)
        if isinstance(default, float) and type(value) is int:
            continue
        if type(value) is not type(default):
            raise values.error(f.name, f"a {type(default).__name__} is needed: was this written by another version?")
    for name in sorted(set(given) - known):
        raise values.error(name, "no such setting: was this written by another version?")
    return kind(**given)
