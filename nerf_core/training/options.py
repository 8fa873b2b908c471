"""The options of training, the same on every command line. They are plain dataclasses that any parser can fill."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.text import suggestion
from nerf_core.datasets import LoadOptions, check_options
from nerf_core.datasets.capture import DATASETS, PoseLens, Quality
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings

if TYPE_CHECKING:
    from nerf_core.training.loop import Goal

MOST_NAME_BYTES = 255  # of a file or folder: the limit of common systems


@dataclass(frozen=True)
class LoadingOptions:
    """Dataset."""

    format: str = "auto"
    """The dataset format; auto recognises it by content. A wrong name is answered with the list of formats."""
    downscale: int = 1
    """Average photos over blocks of so many pixels a side."""
    max_size: int = 0
    """Limit of a photo's longer side in pixels; 0: none."""
    ndc: Literal["auto", "on", "off"] = "auto"
    """Normalised device coordinates; auto: for forward-facing captures where that is possible."""
    background: Literal["auto", "white", "black"] = "auto"
    """What transparent photos lie on; auto: white if they have alpha, else black."""
    memory_gb: float = 8.0
    """What all photos together may take, in memory or, of a large capture, in the cache; they are downscaled further to
    fit."""

    poses: Quality = "normal"
    """Quality with which the poses of photos and videos without poses are found, as of `nerf-core pose --quality`: fast
    takes a third of the time, high doubles the photos to find more points."""
    lens: PoseLens = "perspective"
    """What took photos and videos without poses. Captures with poses say it themselves."""

    def loading(self) -> LoadOptions:
        """Check the options of loading and return them. Raises UserError, which names the wrong option."""
        _check_name("format", self.format, DATASETS.names)
        load = LoadOptions(
            self.format,
            self.downscale,
            self.max_size,
            self.ndc,
            self.background,
            self.memory_gb,
            self.poses,
            self.lens,
        )
        check_options(load)
        return load


@dataclass(frozen=True)
class TrainOptions(LoadingOptions):
    """Dataset, method and training."""

    method: str = "auto"
    """How the scene is learnt; auto: the default for the device."""
    preset: str = "auto"
    """A named set of the method's constants; auto: by device."""
    set: list[str] = field(default_factory=list)
    """NAME=VALUE changes one constant of the method; repeatable."""
    steps: int | None = None
    """Train until this step; the learning schedule spans so many."""
    seconds: float | None = None
    """Train for so many seconds of training steps alone (loading and pictures are not counted). With --steps,
    whichever comes first. The learning schedule never follows the clock."""
    seed: int = 0
    """Of everything random: the same seed gives the same weights on one CPU."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    threads: int = 0
    """Of a CPU, fixed for the whole run; 0: all usable cores."""
    exposure: Literal["auto", "on", "off"] = "auto"
    """Learn a gain and an offset per channel for each training photo; auto: off."""
    refine_poses: bool = False
    """Correct the poses of training photos while the model learns, where left-out pixels agree."""

    def settings(self) -> RunSettings:
        """Check the options and return the settings of the run. Raises UserError, which names the wrong option."""
        if self.steps is not None and self.steps < 1:
            raise UserError(f"--steps {self.steps}: give a whole number from 1 up")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise UserError(f"--seconds {self.seconds}: give a number above 0")
        if not 0 <= self.seed < 2**63:
            raise UserError(f"--seed {shorten(self.seed)}: give a whole number from 0 to 2⁶³ − 1")
        if not 0 <= self.threads <= 1024:
            raise UserError(
                f"--threads {shorten(self.threads)}: give a whole number from 1 to 1024, or 0 for all cores"
            )
        load = self.loading()
        _check_name("method", self.method, METHODS.names)  # which loads torch
        return RunSettings(
            load=load,
            method=self.method,
            preset=self.preset,
            changes=self._changes(),
            steps=self.steps or 0,
            seed=self.seed,
            device=self.device,
            threads=self.threads,
            exposure=self.exposure,
            refine_poses=self.refine_poses,
        )

    def goal(self, total_steps: int) -> Goal:
        """Return when training ends. total_steps: the length of the method's schedule, used without --steps."""
        from nerf_core.training.loop import Goal

        return Goal(self.steps or total_steps, self.seconds or math.inf)

    def _changes(self) -> dict[str, str]:
        changes: dict[str, str] = {}
        for text in self.set:
            name, equals, value = text.partition("=")
            if not equals or not name or not value:
                raise UserError(f"--set {shorten(text)}: write NAME=VALUE, as in --set rays=256")
            if changes.get(name, value) != value:
                raise UserError(f"--set {name}: given as {shorten(changes[name])} and {shorten(value)}; choose one")
            changes[name] = value
        return changes


def loading_words(load: LoadOptions) -> list[str]:
    """Return the words of a command line that give these options of loading; those at their defaults are left out."""
    given = [
        (f.name.replace("_", "-"), getattr(load, f.name)) for f in fields(load) if getattr(load, f.name) != f.default
    ]
    return [word for name, value in given for word in (f"--{name}", str(value))]


def _check_name(option: str, value: str, names: Callable[[], tuple[str, ...]]) -> None:
    if value != "auto" and value not in names():
        near = suggestion(value, names())
        raise UserError(f"--{option} {shorten(value)}{near}: choose from auto, {', '.join(names())}")


def run_name(data: Path | None, method: str) -> str:
    """Return the default name of a run: the scene's folder and the method, joined by a hyphen.

    The folder's name is cut at its end where the whole would be longer than systems allow.
    """
    if data is None:
        return f"demo-{method}"
    folder = data.parent if data.is_file() else data
    name = folder.resolve().name
    while len(os.fsencode(f"{name}-{method}")) > MOST_NAME_BYTES:
        name = name[:-1]
    return f"{name}-{method}"
