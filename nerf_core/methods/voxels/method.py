"""The voxel method: the grid of `nerf_core.methods.voxels.model` as a registered method."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.rays import Rays
from nerf_core.methods import METHODS
from nerf_core.methods.stages import Stage
from nerf_core.methods.voxels.config import VoxelConfig
from nerf_core.methods.voxels.explain import explain
from nerf_core.methods.voxels.model import VoxelModel


@METHODS.register("voxels")
class Voxels(VoxelModel):
    """The voxel method; see `VoxelModel`."""

    summary: ClassVar[str] = marked("A voxel grid with view-dependent colour, trained directly: seconds on a CPU.")

    constants: ClassVar[type[VoxelConfig]] = VoxelConfig
    configure = staticmethod(VoxelConfig.configure)
    restore = staticmethod(VoxelConfig.restore)

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        return explain(self, rays)
