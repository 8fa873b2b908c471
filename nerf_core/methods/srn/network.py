"""The three networks of a Scene Representation Network: the scene Φ, the ray marcher's LSTM and the pixel generator."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

# The share of its usual size that the LSTM's output layer begins with: its part of a step is then about a tenth of the
# bias, if the scene is of about unit size.
FIRST_STEPS = 0.1


class March(NamedTuple):
    """What the marcher did along R rays.

    t: (R, N + 1) the distances t₀ … t_N of the points, in the unit of the origins.
    features: (R, width) Φ at the last point.
    """

    t: Tensor
    features: Tensor


class NormedLayer(nn.Module):
    """ReLU(LayerNorm(W x + b)), with a gain and a bias for each unit of the norm (Ba et al. 2016, arXiv:1607.06450)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear, self.norm = nn.Linear(inputs, outputs), nn.LayerNorm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(P, inputs) → (P, outputs), computed in the precision of x."""
        y = _linear(self.linear, x)
        gain, bias = self.norm.weight.to(x.dtype), self.norm.bias.to(x.dtype)
        return functional.relu(functional.layer_norm(y, self.norm.normalized_shape, gain, bias), inplace=True)


class Marcher(nn.Module):
    """An LSTM cell over features, and a linear layer that turns its output into a step."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.features, self.memory = nn.Linear(width, 4 * hidden), nn.Linear(hidden, 4 * hidden)
        self.step = nn.Linear(hidden, 1)

    def forward(self, v: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Make one step of R rays.

        Args:
            v: (R, width) features of the points.
            h, c: (R, hidden) the LSTM's output and memory so far.

        Returns:
            The steps δ (R,), and the new h and c.

        (i, f, g, o) = W v + U h + b;  c′ = σ(f) c + σ(i) tanh g;  h′ = σ(o) tanh c′;  δ = w h′ + b′. Only W v is in
        the precision of v: an error of δ would add up over the steps.
        """
        i, f, g, o = (_linear(self.features, v).to(h.dtype) + self.memory(h)).chunk(4, -1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        return self.step(h).squeeze(-1), h, c


class SrnNetwork(nn.Module):
    """Φ, marcher and pixel generator of one scene (arXiv:1906.01618, section 3 and its supplement).

    Φ maps a point to features with `layers` layer-normed layers. The pixel generator maps features to a colour with
    `generator_layers` such layers and a linear one. The paper's size, 4 and 5 layers of 256 units and an LSTM of 16
    units, has 550,292 parameters.
    """

    def __init__(
        self, layers: int, generator_layers: int, width: int, hidden: int, precision: torch.dtype | None = None
    ) -> None:
        """precision: of all layers of Φ but its first and of the pixel generator; None: that of the coordinates."""
        super().__init__()
        self.precision = precision
        self.scene = nn.ModuleList(NormedLayer(width if i else 3, width) for i in range(layers))
        self.marcher = Marcher(width, hidden)
        self.generator = nn.ModuleList(NormedLayer(width, width) for _ in range(generator_layers))
        self.rgb = nn.Linear(width, 3)

    @torch.no_grad()
    def initialise(self, generator: torch.Generator, step: float) -> None:
        """Initialise all parameters at random, and the marcher to steps of about `step`.

        Layers before a ReLU get normal weights of variance 2 / inputs (He et al. 2015, arXiv:1502.01852). All others,
        and all biases, are uniform in ±1/√inputs, and in ±1/√hidden in the LSTM, whose forget gates begin open. Without
        biases the norm of Φ's first layer would remove the distance of a point from the origin.

        The paper leaves the first steps to chance, and some seeds begin behind the camera. Here the output layer of the
        LSTM gets small weights, and `step` as its bias, so that a march begins with even steps into the scene.
        """
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = 1 / math.sqrt(module.in_features)
                module.weight.uniform_(-bound, bound, generator=generator)
                module.bias.uniform_(-bound, bound, generator=generator)
        for layer in (*self.scene, *self.generator):
            assert isinstance(layer, NormedLayer)
            layer.linear.weight.normal_(std=math.sqrt(2 / layer.linear.in_features), generator=generator)
        hidden, bound = self.marcher.hidden, 1 / math.sqrt(self.marcher.hidden)
        for gates in (self.marcher.features, self.marcher.memory):
            gates.weight.uniform_(-bound, bound, generator=generator)
            gates.bias.uniform_(-bound, bound, generator=generator)
            gates.bias[hidden : 2 * hidden] = 1
        self.marcher.step.weight.mul_(FIRST_STEPS)
        self.marcher.step.bias.fill_(step)

    def features(self, x: Tensor) -> Tensor:
        """Φ: points (P, 3) → features (P, width)."""
        for layer in self.scene:
            x = layer(x)
            if self.precision is not None:  # after the first layer: 8 bits do not hold bare coordinates
                x = x.to(self.precision)
        return x

    def march(self, origins: Tensor, directions: Tensor, start: Tensor, steps: int) -> March:
        """March along R rays: t_{i+1} = t_i + δ_i, with δ_i from the LSTM over Φ(o + t_i d) (Algorithm 1).

        Args:
            origins: (R, 3) in the coordinates of Φ.
            directions: (R, 3) of unit length.
            start: (R,) t₀, in the unit of the origins.
            steps: N.
        """
        t, places = start, [start]
        h = c = start.new_zeros(len(start), self.marcher.hidden)
        for _ in range(steps):
            step, h, c = self.marcher(self.features(origins + t[:, None] * directions), h, c)
            t = t + step
            places.append(t)
        return March(torch.stack(places, -1), self.features(origins + t[:, None] * directions))

    def color(self, features: Tensor) -> Tensor:
        """Return colours (P, 3) of features (P, width); they may leave [0, 1].

        The paper's colours are in [−1, 1], so that an output of 0 is grey.
        """
        for layer in self.generator:
            features = layer(features)
        return 0.5 + 0.5 * self.rgb(features.to(self.rgb.weight.dtype))


def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a layer in the precision of x."""
    return functional.linear(x, layer.weight.to(x.dtype), layer.bias.to(x.dtype))
