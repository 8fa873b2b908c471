"""The decoder: from the latent code to the template, and from the latent code to the warp."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

LEAK = 0.2  # slope of the leaky ReLU below 0 (the published code)
FOG = -7.0  # softplus(−7) = 0.001 of a voxel's opacity: a ray through 64 of them meets thin fog, and sees all behind it
# On a CPU torch interpolates the items of a batch in parallel, but not the points of one. The points are dealt into so
# many items, however many threads there are, because the order of sums depends on it.
LANES = 2


class Chain:
    """Functions applied one after the other, whose gradient is computed one by one, so that training can yield.

    value: the last function's result, as a leaf: the gradient of the loss is to be collected in `value.grad`.
    """

    def __init__(
        self, start: Tensor, parts: Sequence[Callable[[Tensor], Tensor]], yield_callback: Callable[[], None]
    ) -> None:
        """Apply the parts.

        Args:
            start: the input of the first part.
            parts: functions of one tensor. Their parameters get gradients in `backward`.
            yield_callback: called after each part.
        """
        self._done: list[tuple[Tensor, Tensor]] = []
        for part in parts:
            leaf = start.detach().requires_grad_()
            start = part(leaf)
            self._done.append((leaf, start))
            yield_callback()
        self.value = start.detach().requires_grad_()
        self.value.grad = torch.zeros_like(self.value)  # if no ray meets the box, the gradient is 0

    def backward(self, yield_callback: Callable[[], None]) -> Tensor:
        """Add the parameters' gradients. Returns that of `start`."""
        gradient = self.value.grad
        for leaf, result in reversed(self._done):
            result.backward(gradient)
            gradient = leaf.grad
            yield_callback()
        assert gradient is not None
        return gradient


def applied(parts: Sequence[Callable[[Tensor], Tensor]], x: Tensor) -> Tensor:
    """Apply functions one after the other."""
    for part in parts:
        x = part(x)
    return x


def initialise(module: nn.Linear | nn.ConvTranspose3d, generator: torch.Generator, gain: float) -> None:
    """Draw weights from Glorot's normal distribution times `gain`, and set biases to 0.

    A transposed convolution with stride 2 adds up only 2³ of its 4³ taps in each voxel, which its fan counts.
    """
    if isinstance(module, nn.Linear):
        fan = module.in_features + module.out_features
    else:
        fan = 8 * (module.in_channels + module.out_channels)
    assert module.bias is not None
    with torch.no_grad():
        module.weight.normal_(0, gain * math.sqrt(2 / fan), generator=generator)
        module.bias.zero_()


def leaky(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, LEAK)


GAIN = math.sqrt(2 / (1 + LEAK**2))  # keeps the variance through a leaky ReLU


class Volume(NamedTuple):
    """What the decoder makes of the latent code.

    template: (1, 4, N, N, N) red, green, blue in [0, 1] and the opacity V_α ≥ 0 per unit of the box's half side; the
        last three axes are z, y, x, and the outermost voxels' centres lie on the faces of the cube [−1, 1]³.
    warp: (1, 3, D, D, D) where the points of such a grid lie in the template; None: where they are.
    """

    template: Tensor
    warp: Tensor | None

    def at(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return opacity (P,) and colour (P, 3) at points u (P, 3) of the cube: V(u) = T(W⁻¹(u)).

        Outside the template there is nothing.
        """
        found = sampled(self.template, self.moved(u), "zeros")
        return found[:, 3], found[:, :3]

    def moved(self, u: Tensor) -> Tensor:
        """Return where points u (P, 3) lie in the template, (P, 3): the inverse warp W⁻¹."""
        return u if self.warp is None else sampled(self.warp, u, "border")


def sampled(grid: Tensor, u: Tensor, outside: str) -> Tensor:
    """Interpolate a grid (1, C, D, D, D) at points u (P, 3) of the cube [−1, 1]³, trilinearly: (P, C)."""
    count, lanes = len(u), LANES if grid.device.type == "cpu" else 1
    u = functional.pad(u, (0, 0, 0, -count % lanes)).view(lanes, 1, 1, -1, 3)
    grids = grid.expand(lanes, -1, -1, -1, -1)
    found = functional.grid_sample(grids, u, padding_mode=outside, align_corners=True)
    return found[:, :, 0, 0].mT.reshape(-1, grid.shape[1])[:count]


class Upsampler(nn.Module):
    """Latent code → fully connected layer → transposed convolutions (4³ kernels, stride 2) → side³ voxels.

    The channels begin with `width` and halve at every second layer (the published code); the last layer has `channels`.
    """

    def __init__(self, latent: int, width: int, side: int, channels: int) -> None:
        super().__init__()
        self.side = side
        self.first = nn.Linear(latent, width)
        widths = [max(width >> (k + 1) // 2, 1) for k in range(side.bit_length() - 1)]
        self.ups = nn.ModuleList(nn.ConvTranspose3d(a, b, 4, 2, 1) for a, b in pairwise([*widths, channels]))

    @property
    def layers(self) -> list[nn.ConvTranspose3d]:
        """The transposed convolutions."""
        return [up for up in self.ups if isinstance(up, nn.ConvTranspose3d)]

    def initialise(self, generator: torch.Generator, last: float = 1.0) -> None:
        """Draw all weights; last: the gain of the last layer."""
        initialise(self.first, generator, GAIN)
        for up in self.layers[:-1]:
            initialise(up, generator, GAIN)
        initialise(self.layers[-1], generator, last)

    def parts(self) -> list[Callable[[Tensor], Tensor]]:
        """The functions that turn a latent code (L,) into voxels (1, channels, N, N, N), to be applied in turn."""
        *ups, last = self.layers
        return [self._begin, *(partial(_up, up) for up in ups), last]

    def _begin(self, code: Tensor) -> Tensor:
        return leaky(self.first(code)).view(1, -1, 1, 1, 1)


def _up(up: nn.ConvTranspose3d, x: Tensor) -> Tensor:
    return leaky(up(x))


class Decoder(Upsampler):
    """The decoder of the template."""

    def __init__(self, latent: int, width: int, side: int) -> None:
        super().__init__(latent, width, side, 4)

    def parts(self) -> list[Callable[[Tensor], Tensor]]:
        return [*super().parts(), self.activated]

    def activated(self, raw: Tensor) -> Tensor:
        """Turn raw values (1, 4, N, N, N) into colours in [0, 1] and opacities ≥ 0.

        V_α = softplus(raw + FOG) / voxel. So 1 is the opacity of a voxel that fills a pixel alone, whatever the
        template's resolution. The paper has softplus for colours too, which then need not end at white.
        """
        opacity = functional.softplus(raw[:, 3:] + FOG) * ((self.side - 1) / 2)
        return torch.cat([torch.sigmoid(raw[:, :3]), opacity], 1)
