"""The hash grid's two networks."""

from __future__ import annotations

import torch

from nerf_core.kernels.packed_kernels import HashLevels
from nerf_core.kernels.torch_packed import TorchPacked
from nerf_core.methods.hash.field import FEATURES, HashField


def test_colours_of_points_in_directions_are_those_of_each_pair() -> None:
    generator = torch.Generator().manual_seed(0)
    field = HashField(HashLevels((4, 8)), 64, 2, 32, TorchPacked())
    field.initialise(generator)
    geometry = torch.randn(5, FEATURES, generator=generator)
    d = torch.nn.functional.normalize(torch.randn(7, 3, generator=generator), dim=-1)
    pairs = field.radiance(geometry.repeat_interleave(7, 0), d.repeat(5, 1)).view(5, 7, 3)
    assert float(pairs.detach().std()) > 0.01
    torch.testing.assert_close(field.colors(geometry, d), pairs, atol=1e-6, rtol=0)
