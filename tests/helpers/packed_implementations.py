"""The packed kernels that this process can compare with the plain ones: Triton's if TRITON_INTERPRET=1."""

from __future__ import annotations

import os

from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.torch_packed import TorchPacked

PLAIN = TorchPacked()


def fast() -> dict[str, PackedKernels]:
    """The kernels to compare with `PLAIN`, by name. Triton decides at its import whether it interprets its kernels."""
    if os.environ.get("TRITON_INTERPRET") == "1":
        from nerf_core.kernels.triton_packed import TritonPacked

        return {"triton": TritonPacked()}
    from nerf_core.kernels.cpu_packed import CpuPacked

    return {"1 shard": CpuPacked(1), "3 shards": CpuPacked(3)}
