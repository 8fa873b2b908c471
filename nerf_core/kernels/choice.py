"""Which implementation of the hot loops runs here, and why not a faster one."""

from __future__ import annotations

import torch

from nerf_core.kernels.numba_here import numba_obstacle
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.voxel_kernels import VoxelKernels


def voxel_kernels(device: torch.device) -> VoxelKernels:
    """On a CPU numba's loops, as many at once as torch has threads; elsewhere, or without numba, torch operations."""
    if device.type == "cpu" and not numba_obstacle():
        from nerf_core.kernels.cpu_voxels import CpuVoxels

        return CpuVoxels(torch.get_num_threads())
    from nerf_core.kernels.torch_voxels import TorchVoxels

    return TorchVoxels()


def packed_kernels(device: torch.device) -> PackedKernels:
    """The same, for packed samples and the hash grid."""
    if device.type == "cpu" and not numba_obstacle():
        from nerf_core.kernels.cpu_packed import CpuPacked, compile_loops

        compile_loops()
        return CpuPacked(torch.get_num_threads())
    from nerf_core.kernels.torch_packed import TorchPacked

    return TorchPacked()


def note(device: torch.device) -> str:
    """What is to be told of the choice: nothing where it is the fast one."""
    if device.type == "cpu" and numba_obstacle():
        return f"{numba_obstacle()}: training runs on plain torch operations, some ten times slower"
    return ""
