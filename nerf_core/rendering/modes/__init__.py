"""Render modes: what a picture may show of each pixel besides its colour. One file per mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from nerf_core.common.colormaps import Name, colored
from nerf_core.common.language import marked
from nerf_core.common.registry import Registry
from nerf_core.methods import lacking

if TYPE_CHECKING:
    from torch import Tensor

    from nerf_core.geometry.rays import Rays, Trace
    from nerf_core.methods import Method

COLOR = marked("colour")  # the rendered colour, which needs no `Mode`


class Mode(Protocol):
    """A number per pixel, drawn with a colour map.

    order: the position in menus and on the number keys, after colour.
    label: the name in menus.
    tip: a sentence on what the mode shows.
    low, high: the numbers at which the colour map begins and ends.
    colors: the colour map.

    A mode needs a method with samples along a ray. It may have `needs`, a tuple of what else it needs: keys of
    `nerf_core.methods.ABSENT`.
    """

    order: ClassVar[int]
    label: ClassVar[str]
    tip: ClassVar[str]
    low: ClassVar[float]
    high: ClassVar[float]
    colors: ClassVar[Name]

    @staticmethod
    def values(method: Method, rays: Rays, trace: Trace) -> Tensor:
        """Return the mode's number for each ray.

        Args:
            method: the model.
            rays: R rays.
            trace: what `method` composited along these rays. The preview computes it once, for values and depth.

        Returns:
            (R,) float; NaN where there is none.

        Raises:
            UserError: the method lacks what the mode needs.
        """
        ...


MODES: Registry[type[Mode]] = Registry("render mode", "nerf_core.rendering.modes")


def mode_names() -> tuple[str, ...]:
    """Return the names of all modes in the order of menus and number keys. Colour is the first."""
    return COLOR, *sorted(MODES.names(), key=lambda name: (MODES.get(name).order, name))


def obstacle(method: str, name: str) -> str:
    """Return a sentence if a method cannot draw a mode because it lacks what that needs; empty if it can.

    Args:
        method: the method's name in `METHODS`; empty: there is none yet.
        name: the mode's name in `MODES`, or colour.
    """
    if name == COLOR:
        return ""
    needs = ("trace", *getattr(MODES.get(name), "needs", ()))
    return next(filter(None, (lacking(method, ability) for ability in needs)), "")


def shaded(method: Method, rays: Rays, trace: Trace, name: str) -> np.ndarray:
    """Return what a mode shows of rays.

    Args:
        method: the model.
        rays: R rays.
        trace: what `method` composited along them.
        name: the mode's name in `MODES`; not colour.

    Returns:
        Colours (R, 3) float32 in [0, 1]; black where the mode has no number.

    Raises:
        UserError: the mode is unknown, or the method lacks what it needs.
    """
    mode = MODES.get(name)
    return colored(mode.values(method, rays, trace).float().cpu().numpy(), mode.low, mode.high, mode.colors)
