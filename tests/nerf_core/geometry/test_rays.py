"""Rays and renderings as bundles of tensors."""

from __future__ import annotations

import torch

from nerf_core.geometry.rays import Rays, Rendering


def some(count: int) -> Rays:
    return Rays(torch.rand(count, 3), torch.rand(count, 3), torch.rand(count), torch.rand(count))


def test_padding_repeats_the_last_ray() -> None:
    rays = some(3)
    padded = rays.padded(5)
    assert len(padded) == 5
    assert torch.equal(padded.origins[:3], rays.origins)
    assert torch.equal(padded.directions[3:], rays.directions[-1:].expand(2, 3))
    assert torch.equal(padded.far[3:], rays.far[-1:].expand(2))
    assert rays.padded(3) is rays
    assert rays.padded(2) is rays


def test_indexing_takes_the_same_rays_of_every_field() -> None:
    rays = some(6)
    for index in (slice(1, 4), torch.tensor([5, 0])):
        assert torch.equal(rays[index].near, rays.near[index])
        assert torch.equal(rays[index].directions, rays.directions[index])


def test_renderings_are_joined_in_order() -> None:
    parts = [Rendering(torch.full((n, 3), float(n)), torch.ones(n), torch.zeros(n)) for n in (2, 1)]
    assert torch.equal(Rendering.cat(parts).color[:, 0], torch.tensor([2.0, 2.0, 1.0]))
