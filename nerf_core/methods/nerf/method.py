"""The paper's method: the model of `nerf_core.methods.nerf.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.nerf.config import PRESETS, NerfConfig
from nerf_core.methods.nerf.explain import explain
from nerf_core.methods.nerf.model import NerfModel
from nerf_core.methods.stages import Stage


@METHODS.register("nerf")
class Nerf(NerfModel):
    """The paper's method; see `NerfModel`."""

    summary: ClassVar[str] = marked(
        "The paper's NeRF (2020): two MLPs, every sample through a network; slow, and the reference."
    )

    distributed: ClassVar[bool] = True
    constants: ClassVar[type[NerfConfig]] = NerfConfig
    presets: ClassVar[tuple[str, ...]] = tuple(PRESETS)
    configure = staticmethod(NerfConfig.configure)
    restore = staticmethod(NerfConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
