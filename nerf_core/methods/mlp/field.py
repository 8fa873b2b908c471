"""The paper's network: eight layers for density and one more for colour."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.volume import encodings

SKIP_AFTER = 4  # the sixth layer takes the encoded position once more, as in the official code


class MlpField(nn.Module):
    """(x, d) → raw density, colour: NeRF, figure 7 (arXiv:2003.08934), with the official code's details.

    Density is a linear output of the trunk; rendering applies the ReLU. A feature vector of the trunk's width, without
    activation, and γ(d) feed one ReLU layer of half the width, and a sigmoid gives RGB. Without view directions colour
    is a linear output of the trunk. The official size has 595,844 parameters.
    """

    def __init__(
        self,
        depth: int,
        width: int,
        position_frequencies: int,
        direction_frequencies: int,
        include_input: bool,
        pi: bool,
        view_directions: bool,
        precision: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.precision = precision
        self.position_frequencies = position_frequencies
        self.direction_frequencies = direction_frequencies
        self.include_input, self.pi = include_input, pi
        inputs = encodings.frequency_width(position_frequencies, include_input)
        self.trunk = nn.ModuleList(
            nn.Linear(inputs if i == 0 else width + (inputs if i == SKIP_AFTER + 1 else 0), width) for i in range(depth)
        )
        self.density = nn.Linear(width, 1)
        self.feature = self.branch = None
        if view_directions:
            self.feature = nn.Linear(width, width)
            directions = encodings.frequency_width(direction_frequencies, include_input)
            self.branch = nn.Linear(width + directions, width // 2)
        self.rgb = nn.Linear(width // 2 if view_directions else width, 3)

    def initialise(self, generator: torch.Generator) -> None:
        """Initialise weights Glorot-uniformly and biases with 0, like the official Keras layers."""
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
                with torch.no_grad():
                    layer.weight.uniform_(-bound, bound, generator=generator)
                    layer.bias.zero_()

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Encode unit directions (R, 3) as γ(d) (R, D)."""
        return encodings.frequency(directions, self.direction_frequencies, self.include_input, self.pi)

    def encode_positions(self, x: Tensor) -> Tensor:
        """Encode positions (P, 3) as γ(x) (P, E)."""
        return encodings.frequency(x, self.position_frequencies, self.include_input, self.pi)

    def geometry(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (P,) in float32 and the trunk's output (P, width) in compute precision, at x (P, 3)."""
        with self._autocast():
            encoded = self.encode_positions(x)
            if (
                self.position_frequencies
            ):  # bfloat16's 8 bits hold sines and cosines well enough, but not bare coordinates
                encoded = encoded.to(self.precision)
            h = encoded[:, :0]
            for i, layer in enumerate(self.trunk):
                h = self._joined(layer, encoded, h) if i in (0, SKIP_AFTER + 1) else layer(h)
                h = functional.relu(h, inplace=True)
            return self.density(h).squeeze(-1).float(), h

    def _joined(self, layer: nn.Module, encoded: Tensor, h: Tensor) -> Tensor:
        """A layer over the encoded position and the trunk's h. The position's part is in float32 if `encoded` is."""
        assert isinstance(layer, nn.Linear)
        if encoded.dtype == self.precision:
            return layer(torch.cat([encoded, h], -1) if h.shape[1] else encoded)
        own = encoded.shape[1]
        rest = functional.linear(h, layer.weight[:, own:]) if h.shape[1] else torch.zeros((), device=h.device)
        with torch.autocast(encoded.device.type, enabled=False):
            exact = functional.linear(encoded, layer.weight[:, :own], layer.bias)
        return (exact + rest).to(self.precision)

    def color(self, trunk: Tensor, encoded_directions: Tensor) -> Tensor:
        """Return sRGB-encoded colours (P, 3) in [0, 1], float32, from the trunk's output (P, width) and γ(d) (P, D)."""
        with self._autocast():
            if self.feature is not None and self.branch is not None:
                joined = torch.cat([self.feature(trunk), encoded_directions.to(self.precision)], -1)
                trunk = functional.relu(self.branch(joined), inplace=True)
            return torch.sigmoid(self.rgb(trunk).float())

    def colors(self, trunk: Tensor, encoded_directions: Tensor) -> Tensor:
        """Return `color` of every point in every direction: (P, width), (K, D) → (P, K, 3).

        The branch layer is linear before its ReLU, so that the parts of its two inputs are computed once and added.
        """
        with self._autocast():
            if self.feature is None or self.branch is None:
                return torch.sigmoid(self.rgb(trunk).float())[:, None].expand(-1, len(encoded_directions), -1)
            feature = self.feature(trunk).float()
        own, branch = feature.shape[1], self.branch
        of_points = functional.linear(feature, branch.weight[:, :own], branch.bias)
        of_directions = functional.linear(encoded_directions.float(), branch.weight[:, own:])
        return torch.sigmoid(self.rgb(functional.relu(of_points[:, None] + of_directions)))

    def forward(self, x: Tensor, encoded_directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (P,) and colours (P, 3) at x (P, 3) for γ(d) (P, D)."""
        raw, trunk = self.geometry(x)
        return raw, self.color(trunk, encoded_directions)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.rgb.weight.device.type, self.precision, enabled=self.precision != torch.float32)
