"""The nearest photo: the model of `nerf_core.methods.nearest_view.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.nearest_view.config import NearestViewConfig
from nerf_core.methods.nearest_view.explain import explain
from nerf_core.methods.nearest_view.model import NearestViewModel
from nerf_core.methods.stages import Stage


@METHODS.register("nearest-view")
class NearestView(NearestViewModel):
    """The nearest photo; see `NearestViewModel`."""

    summary: ClassVar[str] = marked(
        "The nearest training photo as it is: no model at all, and what every model should beat."
    )

    constants: ClassVar[type[NearestViewConfig]] = NearestViewConfig
    configure = staticmethod(NearestViewConfig.configure)
    restore = staticmethod(NearestViewConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
