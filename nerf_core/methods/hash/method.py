"""The hash method: the model of `nerf_core.methods.hash.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.hash.config import HashConfig
from nerf_core.methods.hash.explain import explain
from nerf_core.methods.hash.model import HashModel
from nerf_core.methods.stages import Stage


@METHODS.register("hash")
class Hash(HashModel):
    """The hash method; see `HashModel`."""

    summary: ClassVar[str] = marked("Instant-ngp (2022): a hash grid and two small MLPs; made for a GPU.")

    distributed: ClassVar[bool] = True
    constants: ClassVar[type[HashConfig]] = HashConfig
    configure = staticmethod(HashConfig.configure)
    restore = staticmethod(HashConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
