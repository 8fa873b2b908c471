"""The network layer by layer against the paper's figure 7."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from nerf_core.methods.mlp.field import MlpField
from nerf_core.volume import encodings


def official(**changes: Any) -> MlpField:
    constants: dict[str, Any] = {
        "depth": 8, "width": 256, "position_frequencies": 10, "direction_frequencies": 4, "include_input": True,
        "pi": False, "view_directions": True,
    }  # fmt: skip
    field = MlpField(**(constants | changes))
    field.initialise(torch.Generator().manual_seed(0))
    return field


def count(field: nn.Module) -> int:
    return sum(p.numel() for p in field.parameters())


def test_official_size() -> None:
    assert count(official()) == 595_844
    # without the 256 → 256 feature, the 283 → 128 branch and the 128 → 3 colour, but with 256 → 3
    assert count(official(view_directions=False)) == 595_844 - 65_792 - 36_352 - 387 + 771


def test_the_position_enters_again_at_the_sixth_layer() -> None:
    layers = [layer for layer in official().trunk if isinstance(layer, nn.Linear)]
    assert [layer.in_features for layer in layers] == [63, 256, 256, 256, 256, 319, 256, 256]
    assert all(layer.bias is not None for layer in layers)


@pytest.mark.parametrize("depth", [1, 4, 5, 6, 8])
@pytest.mark.parametrize("view_directions", [False, True])
def test_forward_is_the_figure(depth: int, view_directions: bool) -> None:
    field = official(depth=depth, width=24, view_directions=view_directions)
    w = dict(field.named_parameters())

    def linear(name: str, x: torch.Tensor) -> torch.Tensor:
        return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    x = torch.rand(11, 3) * 2 - 1
    d = nn.functional.normalize(torch.randn(11, 3), dim=-1)
    encoded = encodings.frequency(x, 10)
    h = encoded
    for i in range(depth):
        if i == 5:
            h = torch.cat([encoded, h], -1)
        h = linear(f"trunk.{i}", h).clamp(min=0)
    sigma, top = linear("density", h)[:, 0], h
    if view_directions:
        top = linear("branch", torch.cat([linear("feature", h), encodings.frequency(d, 4)], -1)).clamp(min=0)
    got_sigma, got_rgb = field(x, field.encode_directions(d))
    torch.testing.assert_close(got_sigma, sigma)
    torch.testing.assert_close(got_rgb, 1 / (1 + torch.exp(-linear("rgb", top))))


def test_density_does_not_depend_on_the_direction() -> None:
    field, x = official(width=32), torch.rand(5, 3)
    a, b = (field(x, field.encode_directions(nn.functional.normalize(torch.randn(5, 3), dim=-1))) for _ in range(2))
    assert torch.equal(a[0], b[0])
    assert not torch.equal(a[1], b[1])


def test_weights_start_glorot_uniform_and_biases_at_zero() -> None:
    layer = official().trunk[1]
    assert isinstance(layer, nn.Linear)
    bound = (6 / 512) ** 0.5
    assert float(layer.weight.detach().abs().max()) <= bound
    assert float(layer.weight.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.02)
    assert not layer.bias.any()


def test_bfloat16_stays_near_single_precision() -> None:
    exact, fast = official(width=64), official(width=64, precision=torch.bfloat16)
    x, d = torch.rand(50, 3), nn.functional.normalize(torch.randn(50, 3), dim=-1)
    for a, b in zip(exact(x, exact.encode_directions(d)), fast(x, fast.encode_directions(d)), strict=True):
        assert b.dtype == torch.float32
        torch.testing.assert_close(a, b, atol=0.03, rtol=0.03)


def test_bare_coordinates_keep_their_digits_in_bfloat16() -> None:
    """Two points closer than bfloat16 can tell apart (2⁻⁷ at 1 … 2) are still two points for the network."""
    field = official(position_frequencies=0, width=64, precision=torch.bfloat16)
    x = torch.tensor([[1.5, 1.5, 1.5], [1.501, 1.5, 1.5]], requires_grad=True)
    assert x.detach().to(torch.bfloat16).unique(dim=0).shape[0] == 1
    with torch.no_grad():
        # so that the later layers' precision does not hide the difference
        field.trunk[0].get_parameter("weight").mul_(100)
    raw, _ = field.geometry(x)
    assert raw[0] != raw[1]


def test_bare_coordinates_in_bfloat16_stay_near_single_precision() -> None:
    exact = official(position_frequencies=0, width=64)
    fast = official(position_frequencies=0, width=64, precision=torch.bfloat16)
    fast.load_state_dict(exact.state_dict())
    x, d = torch.randn(200, 3), exact.encode_directions(nn.functional.normalize(torch.randn(200, 3), dim=-1))
    for a, b in zip(exact(x, d), fast(x, d), strict=True):
        torch.testing.assert_close(a, b, rtol=0.05, atol=0.05)
