"""The RGBα grid: the model of `nerf_core.methods.rgba_grid.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.rgba_grid.config import GridConfig
from nerf_core.methods.rgba_grid.explain import explain
from nerf_core.methods.rgba_grid.model import GridModel
from nerf_core.methods.stages import Stage


@METHODS.register("rgba-grid")
class RgbaGrid(GridModel):
    """The RGBα grid; see `GridModel`."""

    summary: ClassVar[str] = marked(
        "A dense grid of colour and opacity, composited and optimised directly: RGBα volume rendering before NeRF."
    )

    constants: ClassVar[type[GridConfig]] = GridConfig
    configure = staticmethod(GridConfig.configure)
    restore = staticmethod(GridConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
