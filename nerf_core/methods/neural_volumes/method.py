"""Neural Volumes: the model of `nerf_core.methods.neural_volumes.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.neural_volumes.config import NeuralVolumesConfig
from nerf_core.methods.neural_volumes.explain import explain
from nerf_core.methods.neural_volumes.model import NeuralVolumesModel
from nerf_core.methods.stages import Stage


@METHODS.register("neural-volumes")
class NeuralVolumes(NeuralVolumesModel):
    """Neural Volumes of a static scene; see `NeuralVolumesModel`."""

    summary: ClassVar[str] = marked("Neural Volumes (2019), static scene: decodes a volume and a warp into it.")
    constants: ClassVar[type[NeuralVolumesConfig]] = NeuralVolumesConfig
    configure = staticmethod(NeuralVolumesConfig.configure)
    restore = staticmethod(NeuralVolumesConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
