"""Which implementation of the hot loops runs here, and why not a faster one."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sysconfig
from functools import lru_cache
from pathlib import Path

import torch

from nerf_core.common.jit.cache import numba_obstacle
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.voxel_kernels import VoxelKernels

MOST_SHARDS = 16  # of the voxel grid: each has gradients of its own, 64 bytes a row


def voxel_kernels(device: torch.device) -> VoxelKernels:
    """On a CPU numba's loops, as many at once as torch has threads; elsewhere, or without numba, torch operations."""
    if device.type == "cpu" and not numba_obstacle():
        from nerf_core.kernels.cpu_voxels import CpuVoxels

        return CpuVoxels(min(torch.get_num_threads(), MOST_SHARDS))
    from nerf_core.kernels.torch_voxels import TorchVoxels

    return TorchVoxels()


def packed_kernels(device: torch.device) -> PackedKernels:
    """For packed samples and the hash grid: numba's loops on a CPU, Triton's on CUDA, else torch operations."""
    if device.type == "cpu" and not numba_obstacle():
        from nerf_core.kernels.cpu_packed import CpuPacked, compile_loops

        compile_loops()
        return CpuPacked(torch.get_num_threads())
    if device.type == "cuda" and not triton_obstacle():
        from nerf_core.kernels.triton_packed import TritonPacked

        return TritonPacked()
    from nerf_core.kernels.torch_packed import TorchPacked

    return TorchPacked()


@lru_cache
def triton_obstacle() -> str:
    """Why Triton cannot be used; empty where it can. It compiles its launchers with the system's C compiler."""
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    if not (os.environ.get("CC") or any(shutil.which(name) for name in ("cc", "gcc", "clang"))):
        return "Triton finds no C compiler (install gcc)"
    if not Path(sysconfig.get_paths()["include"], "Python.h").is_file():
        return "Triton finds no Python.h (install python3-dev)"
    return ""


def note(device: torch.device) -> str:
    """What is to be told of the choice: nothing where it is the fast one."""
    if device.type == "cpu" and numba_obstacle():
        return f"{numba_obstacle()}: training runs on plain torch operations, some ten times slower"
    if device.type == "cuda" and triton_obstacle():
        return f"{triton_obstacle()}: training runs on plain torch operations, which is slower"
    return ""
