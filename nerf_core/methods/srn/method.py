"""Scene Representation Networks: the model of `nerf_core.methods.srn.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.srn.config import SrnConfig
from nerf_core.methods.srn.explain import explain
from nerf_core.methods.srn.model import SrnModel
from nerf_core.methods.stages import Stage


@METHODS.register("srn")
class Srn(SrnModel):
    """Scene Representation Networks of a single scene; see `SrnModel`."""

    summary: ClassVar[str] = marked(
        "SRN, single scene (2019): a learned marcher finds one point a ray, and its features the colour; blurred."
    )

    constants: ClassVar[type[SrnConfig]] = SrnConfig
    configure = staticmethod(SrnConfig.configure)
    restore = staticmethod(SrnConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
