"""The kernels that this process can compare with the torch reference, whichever file registers them."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

from nerf_core.common.jit.cache import numba_obstacle
from nerf_core.common.registry import Registry
from nerf_core.kernels.choice import PACKED_KERNELS, VOXEL_KERNELS, Implementation
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.torch_packed import TorchPacked
from nerf_core.kernels.voxel_kernels import VoxelKernels

T = TypeVar("T")
PLAIN = TorchPacked()


def usable(registry: Registry[type[Implementation[T]]]) -> dict[str, Callable[[], T]]:
    """What makes the kernels of each registered implementation that runs on this CPU, except the reference, by name."""
    kinds = {name: registry.get(name) for name in registry.names() if name != "torch"}
    return {
        name: kind.make for name, kind in kinds.items() if "cpu" in (kind.devices or ("cpu",)) and not kind.obstacle()
    }


def fast_packed() -> dict[str, PackedKernels]:
    """The packed kernels to compare with `PLAIN`. Triton decides at its import whether it interprets its kernels."""
    if os.environ.get("TRITON_INTERPRET") == "1":
        from nerf_core.kernels import triton_packed

        # one program takes its interpreter as long for large blocks as for small ones
        triton_packed.POINTS, triton_packed.RAYS, triton_packed.ROWS = 1024, 128, 2048
        return {"triton": triton_packed.TritonPacked()}
    found = {name: make() for name, make in usable(PACKED_KERNELS).items()}
    if not numba_obstacle():
        from nerf_core.kernels.cpu_packed import CpuPacked

        found |= {"1 shard": CpuPacked(1), "3 shards": CpuPacked(3)}
    return found


def fast_voxels() -> dict[str, Callable[[], VoxelKernels]]:
    """What makes the voxel kernels to compare with `TorchVoxels`."""
    found = usable(VOXEL_KERNELS)
    if not numba_obstacle():
        from nerf_core.kernels.cpu_voxels import CpuVoxels

        found |= {"1 shard": lambda: CpuVoxels(1), "3 shards": lambda: CpuVoxels(3)}
    return found
