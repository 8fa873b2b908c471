"""Choose the device, and ask what it supports and how much memory is used."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from nerf_core.common.errors import UserError
from nerf_core.common.language import phrases


def pick_device(name: str) -> torch.device:
    """Return the device called auto, cpu, cuda or cuda:N. Raises UserError if this machine does not have it."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"--device {name}: choose auto, cpu, cuda or cuda:N") from None
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"--device {name}: only cpu and cuda are supported")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(
            f"--device {name}: this machine offers {torch.cuda.device_count()} CUDA devices; use --device cpu"
        )
    return device


def describe(device: torch.device) -> str:
    """Return the device's name for status lines."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return phrases("CPU, {n:,} thread", "CPU, {n:,} threads", torch.get_num_threads())


def fast_precision(device: torch.device) -> str:
    """Return the type for matrix products: "bfloat16" where it is much faster, else "float32".

    It is faster on CUDA from Ampere on and on processors with AVX-512 BF16 or AMX.
    """
    if device.type == "cuda":
        fast = torch.cuda.get_device_capability(device)[0] >= 8
    else:
        # The public API has no such query; torch's own tests use these two private ones.
        fast = torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
    return "bfloat16" if fast else "float32"


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_memory() -> int:
    """Return the bytes of memory that this machine has, used or free."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def memory_held(device: torch.device) -> int:
    """Return the bytes that this process holds: on the GPU, or, for the CPU, resident in memory."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux: the standard library only knows the peak
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


@contextmanager
def enough_memory() -> Iterator[None]:
    """Raise UserError if a picture does not fit on the device.

    Pictures are drawn in the middle of training steps. torch's own error would look like one of the step.
    """
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"out of device memory for a picture ({error}): close other programs that use the device"
        ) from None
