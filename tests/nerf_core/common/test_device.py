"""Devices by name."""

from __future__ import annotations

import pytest
import torch

from nerf_core.common.device import describe, fast_precision, pick_device, usable_cores
from nerf_core.common.errors import UserError
from nerf_core.common.text import counted


def test_cpu_is_always_there() -> None:
    assert pick_device("cpu") == torch.device("cpu")
    assert pick_device("auto").type in ("cpu", "cuda")
    assert describe(torch.device("cpu")) == f"CPU, {counted(torch.get_num_threads(), 'thread')}"
    assert fast_precision(torch.device("cpu")) in ("float32", "bfloat16")
    assert usable_cores() >= 1


@pytest.mark.parametrize(
    ("name", "said"),
    [("gpu", "choose auto, cpu, cuda"), ("meta", "only cpu and cuda"), ("cuda:99", "this machine offers")],
)
def test_a_wrong_device_lists_the_choices(name: str, said: str) -> None:
    with pytest.raises(UserError, match=f"--device {name}: .*{said}"):
        pick_device(name)
