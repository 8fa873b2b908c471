"""Neural Volumes: the model of `nerf_core.methods.neural_volumes.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.methods import METHODS
from nerf_core.methods.neural_volumes.config import NeuralVolumesConfig
from nerf_core.methods.neural_volumes.model import NeuralVolumesModel


@METHODS.register("neural-volumes")
class NeuralVolumes(NeuralVolumesModel):
    """Neural Volumes of a static scene; see `NeuralVolumesModel`."""

    summary: ClassVar[str] = "Neural Volumes, static scene (2019): a decoder draws a volume, a warp lends it resolution."
    constants: ClassVar[type[NeuralVolumesConfig]] = NeuralVolumesConfig
    configure = staticmethod(NeuralVolumesConfig.configure)
    restore = staticmethod(NeuralVolumesConfig.restore)
