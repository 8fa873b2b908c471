"""The network of Flatland: from a point and a direction of the plane to a density and a colour."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.volume.encodings import frequency, frequency_width

WIDTH, COLOR_WIDTH = 64, 32  # units of a hidden layer, and of the layer that sees the direction
DENSITY_SCALE = 10.0  # density of an output of 1: weights of order 1 then reach the world's 40


class FlatNetwork(nn.Module):
    """The paper's network for two dimensions, with two hidden layers of `WIDTH` in place of eight of 256.

    γ(x, y) → hidden → hidden → σ and a feature; feature and γ(φ) → hidden → rgb. As in the paper, σ does not depend on
    the direction.
    """

    def __init__(self, frequencies: int, directions: int, generator: torch.Generator) -> None:
        """Make it with random weights.

        Args:
            frequencies: L of the position (NeRF Eq. 4); 0: bare coordinates.
            directions: L of the direction; 0: the colour does not depend on it.
            generator: of the weights.
        """
        super().__init__()
        self.frequencies, self.directions = frequencies, directions
        self.first = nn.Linear(frequency_width(frequencies, False, 2), WIDTH)
        self.second = nn.Linear(WIDTH, WIDTH)
        self.density = nn.Linear(WIDTH, 1)
        self.feature = nn.Linear(WIDTH, COLOR_WIDTH)
        self.view = nn.Linear(2 * directions, COLOR_WIDTH, bias=False) if directions else None
        self.color = nn.Linear(COLOR_WIDTH, 3)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                with torch.no_grad():
                    bound = math.sqrt(6 / (layer.in_features + layer.out_features))
                    layer.weight.uniform_(-bound, bound, generator=generator)
                    if layer.bias is not None:
                        layer.bias.zero_()

    def forward(
        self, p: Float[Tensor, "P 2"], d: Float[Tensor, "R 2"]
    ) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 3"]]:
        """Return σ and colour at points p, P / R of them along each of R rays of directions d of unit length.

        The direction is encoded as its angle φ: sin 2^k φ and cos 2^k φ, which are smooth all around.
        """
        h = functional.relu(self.first(frequency(p, self.frequencies, False, True)))
        h = functional.relu(self.second(h))
        sigma = DENSITY_SCALE * functional.softplus(self.density(h)[:, 0] - 1)
        c = self.feature(h)
        if self.view is not None:
            phi = torch.atan2(d[:, 1:], d[:, :1])
            of_rays = self.view(frequency(phi, self.directions, False))
            c = (c.view(len(d), -1, COLOR_WIDTH) + of_rays[:, None]).flatten(0, 1)
        return sigma, torch.sigmoid(self.color(functional.relu(c)))
