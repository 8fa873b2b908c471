"""Loops compiled by numba, on a CPU, with as many threads as torch has."""

from __future__ import annotations

from typing import ClassVar

import torch

from nerf_core.common.jit.cache import numba_obstacle
from nerf_core.common.language import marked
from nerf_core.kernels.choice import PACKED_KERNELS, VOXEL_KERNELS
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.voxel_kernels import MOST_SHARDS, VoxelKernels


class _OnNumba:
    devices: ClassVar[tuple[str, ...]] = ("cpu",)
    rank: ClassVar[int] = 0
    summary: ClassVar[str] = marked("loops compiled by numba")
    without: ClassVar[str] = marked("some ten times slower")

    @staticmethod
    def obstacle() -> str:
        return numba_obstacle()


@VOXEL_KERNELS.register("numba")
class VoxelsOnNumba(_OnNumba):
    @staticmethod
    def make() -> VoxelKernels:
        from nerf_core.common.jit.apart import compile_loops
        from nerf_core.kernels.cpu_voxels import CpuVoxels, call_each

        compile_loops(call_each)
        return CpuVoxels(min(torch.get_num_threads(), MOST_SHARDS))


@PACKED_KERNELS.register("numba")
class PackedOnNumba(_OnNumba):
    @staticmethod
    def make() -> PackedKernels:
        from nerf_core.common.jit.apart import compile_loops
        from nerf_core.kernels.cpu_packed import CpuPacked, call_each

        compile_loops(call_each)
        return CpuPacked(torch.get_num_threads())
