"""The mode that shows how much a point's colour depends on the direction from which it is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from nerf_core.common.colormaps import Name
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked
from nerf_core.methods import METHODS, Method, Radiant, lacking
from nerf_core.rendering.modes import MODES

if TYPE_CHECKING:
    from torch import Tensor

    from nerf_core.geometry.rays import Rays, Samples, Trace

NOTHING = 0.05  # under this opacity a ray has hit nothing visible, and the pixel has no number


@MODES.register(marked("view-dependence"))
class ViewDependence:
    """The standard deviation of the emitted colour over the hemisphere of directions that face the camera."""

    order: ClassVar[int] = 1
    label: ClassVar[str] = marked("View-dependence")
    tip: ClassVar[str] = marked(
        "how much the colour at a pixel's point differs over the directions that face the camera: 0 is matt"
    )
    low: ClassVar[float] = 0.0
    high: ClassVar[float] = 0.25
    colors: ClassVar[Name] = "viridis"
    needs: ClassVar[tuple[str, ...]] = ("radiance",)

    @staticmethod
    def values(method: Method, rays: Rays, trace: Trace) -> Tensor:
        """Return the view-dependence of each ray's point, as `Mode.values` says.

        Raises UserError if the method has no radiance at a point.
        """
        import torch

        from nerf_core.rendering.view_dependence import view_dependence

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
    """Return the world distance (R,) of each ray's point; NaN if the ray hits nothing.

    The point is the first sample at which the accumulated weight reaches 0.5, else the strongest sample.

    samples: those of R rays.
    """
    import torch

    weights = samples.weights.double()
    median = (weights.cumsum(-1) < 0.5).sum(-1)
    strongest = weights.argmax(-1)
    index = torch.where(median < weights.shape[1], median, strongest)
    t = samples.t.gather(1, index[:, None])[:, 0]
    return torch.where(weights.sum(-1) >= NOTHING, t, torch.nan)
