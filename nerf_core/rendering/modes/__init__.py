"""What a picture may show of each pixel besides its colour: one file per mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from nerf_core.common.colormaps import Name, colored
from nerf_core.common.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from nerf_core.geometry.rays import Rays, Trace
    from nerf_core.methods import Method

COLOR = "colour"  # the picture itself, which needs no mode


class Mode(Protocol):
    """A number per pixel, drawn with a colour map.

    order: position in menus and on the number keys, after colour. label: for menus. tip: a sentence on what it shows.
    low, high: the numbers at which the colour map begins and ends. colors: the map.
    """

    order: ClassVar[int]
    label: ClassVar[str]
    tip: ClassVar[str]
    low: ClassVar[float]
    high: ClassVar[float]
    colors: ClassVar[Name]

    @staticmethod
    def values(method: Method, rays: Rays, trace: Trace) -> Tensor:
        """The mode's number for each of R rays, (R,) float; NaN where there is none.

        trace: what `method` composited along these rays. The preview computes it once, for values and depth alike.
        """
        ...


MODES: Registry[type[Mode]] = Registry("render mode", "nerf_core.rendering.modes")


def mode_names() -> tuple[str, ...]:
    """Colour, then the modes in the order of menus and number keys."""
    return COLOR, *sorted(MODES.names(), key=lambda name: (MODES.get(name).order, name))


def shaded(method: Method, rays: Rays, trace: Trace, name: str) -> np.ndarray:
    """The colours (R, 3) float32 of a mode; black where it has no number."""
    mode = MODES.get(name)
    return colored(mode.values(method, rays, trace).float().cpu().numpy(), mode.low, mode.high, mode.colors)
