"""The guided method: the model of `nerf_core.methods.guided.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.guided.config import GuidedConfig
from nerf_core.methods.guided.explain import explain
from nerf_core.methods.guided.model import GuidedModel
from nerf_core.methods.stages import Stage


@METHODS.register("nerf-guided")
class GuidedNerf(GuidedModel):
    """The guided method; see `GuidedModel`."""

    summary: ClassVar[str] = marked(
        "The paper's network, its samples placed by a voxel grid trained first: minutes on a CPU."
    )

    constants: ClassVar[type[GuidedConfig]] = GuidedConfig
    configure = staticmethod(GuidedConfig.configure)
    restore = staticmethod(GuidedConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
