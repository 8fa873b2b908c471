"""The Triton kernels through their interpreter, against the plain ones: what a CPU can know of them.

Run by test_triton.py: Triton decides when it is imported whether kernels are to be interpreted.
"""

from __future__ import annotations

import os

import pytest
import torch

from nerf_core.kernels.packed_kernels import HashLevels, PackedKernels, Samples
from nerf_core.kernels.torch_packed import TorchPacked

PLAIN = TorchPacked()
LEVELS = HashLevels((2, 5, 11, 40))
WHITE = torch.tensor([1.0, 0.5, 0.25])


@pytest.fixture(scope="module")
def kernels() -> PackedKernels:
    assert os.environ["TRITON_INTERPRET"] == "1", "run by test_triton.py, in a process of its own"
    from nerf_core.kernels.triton_packed import TritonPacked

    return TritonPacked()


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("width", [2, 4])
def test_features_and_their_gradients_agree(kernels: PackedKernels, width: int) -> None:
    table = torch.randn(4, 512, width, generator=generator(2))
    x = torch.rand(150, 3, generator=generator(3))
    x[0], x[1] = 0, 1
    features = kernels.encode(table, LEVELS, x)
    torch.testing.assert_close(features, PLAIN.encode(table, LEVELS, x), atol=1e-5, rtol=1e-5)
    gradient = torch.randn(features.shape, generator=generator(4))
    found = [torch.zeros_like(table), torch.zeros_like(table)]
    for into, k in zip(found, (kernels, PLAIN), strict=True):
        k.encode_gradient(gradient, LEVELS, x, into)
    torch.testing.assert_close(found[0], found[1], atol=1e-4, rtol=1e-4)


def test_compositing_and_its_gradient_agree(kernels: PackedKernels) -> None:
    counts = torch.randint(0, 10, (90,), generator=generator(1))
    counts[:2], counts[-1] = 0, 0
    total = int(counts.sum())
    ends = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    tau, rgb = torch.rand(total, generator=generator(2)), torch.rand(total, 3, generator=generator(3))
    tau[::7], tau[3::11] = 0, 30
    samples = Samples(ends, torch.rand(total, 3), torch.rand(total, generator=generator(4)), torch.ones(total))
    known = tau, rgb, samples, WHITE
    torch.testing.assert_close(kernels.composite(*known), PLAIN.composite(*known), atol=1e-5, rtol=1e-5)
    gradient = torch.randn(90, 3, generator=generator(5))
    for fast, plain in zip(
        kernels.composite_gradient(gradient, *known), PLAIN.composite_gradient(gradient, *known), strict=True
    ):
        torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-4)


def test_adam_agrees(kernels: PackedKernels) -> None:
    results = []
    for k in (kernels, PLAIN):
        table = torch.randn(2, 300, 2, generator=generator(0))
        moments = torch.zeros_like(table), torch.zeros_like(table)
        for step in (1, 2):
            gradient = torch.randn(table.shape, generator=generator(step))
            gradient[:, ::3] = 0
            k.adam(table, gradient, moments, 0.1, step)
            assert not gradient.any()
        results.append((table, *moments))
    for fast, plain in zip(*results, strict=True):
        torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-4)
