"""Freed memory is given back where the C library can do it, and nothing happens where it cannot."""

from __future__ import annotations

import ctypes
import os
import sys
from types import SimpleNamespace

import pytest
import torch

from nerf_core.common.memory import give_back


def resident() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_freed_blocks_are_given_back() -> None:
    blocks = [torch.ones(1 << 14) for _ in range(2048)]  # 64 KB each, too small to be mapped one by one
    last = torch.ones(1 << 14)  # above them, so that freeing them alone gives nothing back
    before = resident()
    del blocks
    give_back()
    assert resident() < before - 100 * 2**20
    assert last.sum() == 1 << 14


@pytest.mark.parametrize("fault", [OSError, TypeError, AttributeError])
def test_other_libraries_are_left_alone(fault: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    def library(_: None) -> SimpleNamespace:
        if fault is AttributeError:
            return SimpleNamespace()
        raise fault

    monkeypatch.setattr(ctypes, "CDLL", library)
    give_back()
