"""Triton kernels for packed samples and the hash grid, on CUDA."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sysconfig
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.kernels.choice import PACKED_KERNELS
from nerf_core.kernels.packed_kernels import PackedKernels


@PACKED_KERNELS.register("triton")
class PackedOnTriton:
    devices: ClassVar[tuple[str, ...]] = ("cuda",)
    rank: ClassVar[int] = 0
    summary: ClassVar[str] = marked("Triton's kernels")
    without: ClassVar[str] = marked("which is slower")

    @staticmethod
    @lru_cache
    def obstacle() -> str:
        """Triton compiles its launchers with the system's C compiler."""
        if importlib.util.find_spec("triton") is None:
            return "Triton is not installed"
        if not (os.environ.get("CC") or any(shutil.which(name) for name in ("cc", "gcc", "clang"))):
            return "Triton finds no C compiler (install gcc)"
        if not Path(sysconfig.get_paths()["include"], "Python.h").is_file():
            return "Triton finds no Python.h (install python3-dev)"
        return ""

    @staticmethod
    def make() -> PackedKernels:
        from nerf_core.kernels.triton_packed import TritonPacked

        return TritonPacked()
