"""The wishes of the command line, checked before training starts."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.user_paths import absolute
from nerf_core.live.messages import MOST_PINS
from nerf_core.probe.axis import AxisChoice
from nerf_core.probe.report import FORMATS
from nerf_core.rendering.modes import COLOR, mode_names
from nerf_core.training.checkpoint import describe

from ..model.state import TourWish


@dataclass(frozen=True)
class Wishes:
    """The files to write, and what to do before; see `viewer.cli.ViewerOptions`.

    folder: where the files go if the user asked for none; None: the user did.
    tour: the tour that begins, once the scene is open; None: none.
    orbit_seconds: make the orbit's frames small enough to take about so long; None: as large as the photos.
    """

    folder: Path | None = None
    load: Path | None = None
    steps: int | None = None
    seconds: float | None = None
    save: Path | None = None
    camera: str = ""
    mode: str = COLOR
    pins: tuple[tuple[str, str], ...] = ()
    clicks: tuple[tuple[str, str], ...] = ()
    inspect: tuple[Path, ...] = ()
    axis: AxisChoice = "auto"
    render: Path | None = None
    orbit: Path | None = None
    orbit_seconds: float | None = None
    screenshot: Path | None = None
    tour: TourWish | None = None

    def any_file(self) -> bool:
        return bool(self.files())

    def files(self) -> tuple[Path, ...]:
        found = (self.save, *self.inspect, self.render, self.orbit, self.screenshot)
        return tuple(p for p in found if p is not None)

    def check(self) -> None:
        """Raise UserError for a wish that cannot be fulfilled, before hours are spent on training."""
        if self.mode not in mode_names():
            raise UserError(f"--mode {shorten(self.mode)}: choose from {', '.join(mode_names())}")
        if len(self.pins) > MOST_PINS:
            raise UserError(
                f"--pin: given {len(self.pins)} times; {MOST_PINS} rays at most can be pinned: leave some out"
            )
        for option, places in (("click", self.clicks), ("pin", self.pins)):
            for place in places:
                for text in place:
                    coordinate(option, text)
        if self.load is not None:
            describe(self.load)
        if self.inspect and not self.clicks:
            raise UserError(f"--inspect {self.inspect[0]}: of which ray? add --click X Y")
        kinds = [
            ("screenshot", self.screenshot, (".png",)),
            ("render", self.render, (".png", ".npy")),
            ("orbit", self.orbit, (".mp4",)),
            *(("inspect", file, tuple(FORMATS)) for file in self.inspect),
        ]
        for option, file, suffixes in kinds:
            if file is not None and file.suffix.lower() not in suffixes:
                raise UserError(f"--{option} {file}: name a {' or '.join(suffixes)} file")
        for file in self.files():
            folder = next(parent for parent in absolute(file).parents if parent.exists())
            if file.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
                raise UserError(f"{file}: cannot be written: choose a file in a folder that you may write to")


def coordinate(option: str, text: str) -> float:
    """Parse a coordinate of --click or --pin: a fraction of the viewport if it has a decimal point, else pixels."""
    try:
        value = float(text) if "." in text else int(text)
    except ValueError:
        raise UserError(f"--{option} {text}: expected a whole number of pixels, or a fraction such as 0.5") from None
    if not 0 <= value <= (1 if "." in text else math.inf):  # NaN fails this comparison too
        raise UserError(f"--{option} {text}: lies outside the viewport")
    return value
