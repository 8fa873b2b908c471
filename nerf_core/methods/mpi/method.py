"""Multiplane images: the model of `nerf_core.methods.mpi.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.mpi.config import MpiConfig
from nerf_core.methods.mpi.explain import explain
from nerf_core.methods.mpi.model import MpiModel
from nerf_core.methods.stages import Stage


@METHODS.register("mpi")
class Mpi(MpiModel):
    """The multiplane images; see `MpiModel`."""

    summary: ClassVar[str] = marked(
        "Optimised MPIs (LLFF-style blending): stacks of RGBα planes, for forward-facing captures."
    )

    constants: ClassVar[type[MpiConfig]] = MpiConfig
    configure = staticmethod(MpiConfig.configure)
    restore = staticmethod(MpiConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
