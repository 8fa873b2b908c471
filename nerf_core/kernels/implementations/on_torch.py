"""Torch operations. They run on every device, and the other implementations are tested against them."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.kernels.choice import PACKED_KERNELS, VOXEL_KERNELS
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.voxel_kernels import VoxelKernels


class _OnTorch:
    devices: ClassVar[tuple[str, ...]] = ()
    rank: ClassVar[int] = 100
    summary: ClassVar[str] = marked("plain torch operations")
    without: ClassVar[str] = ""

    @staticmethod
    def obstacle() -> str:
        return ""


@VOXEL_KERNELS.register("torch")
class VoxelsOnTorch(_OnTorch):
    @staticmethod
    def make() -> VoxelKernels:
        from nerf_core.kernels.torch_voxels import TorchVoxels

        return TorchVoxels()


@PACKED_KERNELS.register("torch")
class PackedOnTorch(_OnTorch):
    @staticmethod
    def make() -> PackedKernels:
        from nerf_core.kernels.torch_packed import TorchPacked

        return TorchPacked()
