"""The paper's network: eight layers for density, one more for colour."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.volume import encodings

SKIP_AFTER = 4  # the encoded position enters again at the input of the sixth layer, as in the official code


class MlpField(nn.Module):
    """(x, d) → raw density, colour: NeRF, figure 7 (arXiv:2003.08934), with the official code's details.

    Density is linear from the trunk (ReLU at rendering). A feature of the trunk's width without activation, joined
    by γ(d), feeds one ReLU layer of half the width, then sigmoid RGB. Without view directions colour is linear
    from the trunk. 595,844 parameters at the official size.
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
        """Glorot-uniform weights and zero biases, as the official Keras layers have."""
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
                with torch.no_grad():
                    layer.weight.uniform_(-bound, bound, generator=generator)
                    layer.bias.zero_()

    def encode_directions(self, directions: Tensor) -> Tensor:
        """γ(d): unit (R, 3) → (R, D)."""
        return encodings.frequency(directions, self.direction_frequencies, self.include_input, self.pi)

    def encode_positions(self, x: Tensor) -> Tensor:
        """γ(x): (P, 3) → (P, E)."""
        return encodings.frequency(x, self.position_frequencies, self.include_input, self.pi)

    def geometry(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x (P, 3) → raw density (P,) float32, trunk output (P, width) in the compute precision."""
        with self._autocast():
            encoded = self.encode_positions(x)
            if self.position_frequencies:  # 8 bits hold sines and cosines, but not bare coordinates
                encoded = encoded.to(self.precision)
            h = encoded[:, :0]
            for i, layer in enumerate(self.trunk):
                h = self._joined(layer, encoded, h) if i in (0, SKIP_AFTER + 1) else layer(h)
                h = functional.relu(h, inplace=True)
            return self.density(h).squeeze(-1).float(), h

    def _joined(self, layer: nn.Module, encoded: Tensor, h: Tensor) -> Tensor:
        """A layer that the encoded position enters, in front of the trunk's h; in float32 where that is float32."""
        assert isinstance(layer, nn.Linear)
        if encoded.dtype == self.precision:
            return layer(torch.cat([encoded, h], -1) if h.shape[1] else encoded)
        own = encoded.shape[1]
        rest = functional.linear(h, layer.weight[:, own:]) if h.shape[1] else torch.zeros((), device=h.device)
        with torch.autocast(encoded.device.type, enabled=False):
            exact = functional.linear(encoded, layer.weight[:, :own], layer.bias)
        return (exact + rest).to(self.precision)

    def color(self, trunk: Tensor, encoded_directions: Tensor) -> Tensor:
        """Trunk output (P, width), γ(d) (P, D) → sRGB-encoded colour (P, 3) in [0, 1], float32."""
        with self._autocast():
            if self.feature is not None and self.branch is not None:
                joined = torch.cat([self.feature(trunk), encoded_directions.to(self.precision)], -1)
                trunk = functional.relu(self.branch(joined), inplace=True)
            return torch.sigmoid(self.rgb(trunk).float())

    def colors(self, trunk: Tensor, encoded_directions: Tensor) -> Tensor:
        """`color` of every point with every direction: (P, width), (K, D) → (P, K, 3).

        The branch layer is linear before its ReLU, so that its two inputs' parts are computed once each, and added.
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
        """x (P, 3), γ(d) (P, D) → raw density (P,), colour (P, 3)."""
        raw, trunk = self.geometry(x)
        return raw, self.color(trunk, encoded_directions)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.rgb.weight.device.type, self.precision, enabled=self.precision != torch.float32)
