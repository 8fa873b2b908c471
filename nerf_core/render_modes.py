"""What a picture may show of each pixel besides its colour."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.colormaps import Name, colored
from nerf_core.methods import Method
from nerf_core.probe.radiance import view_dependence
from nerf_core.types import Rays, Samples


class Mode(NamedTuple):
    """label: for menus. tip: what it shows. values: rays (R,) → a number each, NaN where there is none. low, high: the
    numbers at which the map begins and ends."""

    label: str
    tip: str
    values: Callable[[Method, Rays], Tensor]
    low: float
    high: float
    colors: Name = "viridis"


NOTHING = 0.05  # opacity under which a pixel shows nothing that a number could be told of


def depths(samples: Samples) -> Tensor:
    """Where a ray's point lies, (R,): at half of the accumulated weight, else at the strongest sample; NaN: nowhere."""
    weights = samples.weights.double()
    median = (weights.cumsum(-1) < 0.5).sum(-1)
    strongest = weights.argmax(-1)
    index = torch.where(median < weights.shape[1], median, strongest)
    t = samples.t.gather(1, index[:, None])[:, 0]
    return torch.where(weights.sum(-1) >= NOTHING, t, torch.nan)


def dependence(method: Method, rays: Rays) -> Tensor:
    t = depths(method.trace(rays).passes[-1]).cpu()
    hit = torch.isfinite(t).nonzero()[:, 0]
    origins, directions = rays.origins.cpu().double()[hit], rays.directions.cpu().double()[hit]
    values = torch.full_like(t, torch.nan)
    if len(hit):
        values[hit] = view_dependence(method, origins + t[hit, None] * directions, -directions).to(values)
    return values


MODES = {
    "view-dependence": Mode(
        "View-dependence",
        "how much the colour at a pixel's point differs over the directions that face the camera: 0 is matt",
        dependence, 0.0, 0.25,
    ),
}  # fmt: skip
COLOR = "colour"  # the name of what needs no mode


def shaded(method: Method, rays: Rays, name: str) -> np.ndarray:
    """The colours (R, 3) of a mode; black where it has no number."""
    mode = MODES[name]
    return colored(mode.values(method, rays).float().cpu().numpy(), mode.low, mode.high, mode.colors)
