"""How much a point's colour depends on the direction from which it is seen."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nerf_core.common.colormaps import Name
from nerf_core.common.errors import UserError
from nerf_core.geometry.rays import Rays, Samples, Trace
from nerf_core.methods import METHODS, Method, Radiant, lacking
from nerf_core.rendering.modes import MODES
from nerf_core.rendering.view_dependence import view_dependence

NOTHING = 0.05  # opacity under which a pixel shows nothing that a number could be told of


@MODES.register("view-dependence")
class ViewDependence:
    """The standard deviation of the emitted colour over the hemisphere of directions that face the camera."""

    order: ClassVar[int] = 1
    label: ClassVar[str] = "View-dependence"
    tip: ClassVar[str] = (
        "how much the colour at a pixel's point differs over the directions that face the camera: 0 is matt"
    )
    low: ClassVar[float] = 0.0
    high: ClassVar[float] = 0.25
    colors: ClassVar[Name] = "viridis"

    @staticmethod
    def values(method: Method, rays: Rays, trace: Trace) -> Tensor:
        """(R,), see `view_dependence`; NaN where the ray hits nothing. Raises UserError without a radiance."""
        if not isinstance(method, Radiant):
            raise UserError(f"{lacking(METHODS.name_of(type(method)), 'radiance')}: choose another picture")
        t = depths(trace.passes[-1]).cpu()
        hit = torch.isfinite(t).nonzero()[:, 0]
        origins, directions = rays.origins.cpu().double()[hit], rays.directions.cpu().double()[hit]
        found = torch.full_like(t, torch.nan)
        if len(hit):
            found[hit] = view_dependence(method, origins + t[hit, None] * directions, -directions).to(found)
        return found


def depths(samples: Samples) -> Tensor:
    """The distance (R,) of each ray's point: the median of its weights, else the strongest sample; NaN: no point."""
    weights = samples.weights.double()
    median = (weights.cumsum(-1) < 0.5).sum(-1)
    strongest = weights.argmax(-1)
    index = torch.where(median < weights.shape[1], median, strongest)
    t = samples.t.gather(1, index[:, None])[:, 0]
    return torch.where(weights.sum(-1) >= NOTHING, t, torch.nan)
