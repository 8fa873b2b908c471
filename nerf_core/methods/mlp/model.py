"""The paper's networks with their optimiser, shared by the methods that use them; methods differ in placing samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Defaults
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.methods.mlp.field import MlpField


class Parametrised(NamedTuple):
    """Rays in the coordinates of the network: x = origins + u · directions with u in [near, far]; see `Ndc`."""

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    length: Tensor  # length of `directions`; it turns steps of u into δ
    exists: Tensor  # False for rays that never enter the frustum of NDC; they show the background
    encoded: Tensor  # γ(d)


class MlpModel(Defaults):
    """Networks by name; the last one draws the picture. `config` is an `MlpConfig`."""

    def __init__(
        self, scene: Scene, config: Any, device: torch.device, generator: torch.Generator, names: Sequence[str]
    ) -> None:
        self.config, self.device, self.generator = config, device, generator
        self.generators = (generator,)
        self.ndc = scene.ndc
        self.background = torch.tensor(scene.background, device=device)
        start = torch.Generator().manual_seed(generator.initial_seed())
        self.networks = {name: self._network(start) for name in names}
        self.optimizer = Adam(self.parameters(), lr=config.learning_rate, eps=config.adam_epsilon)
        for parameter in (
            self.parameters()
        ):  # Adam skips parameters without a gradient; with zeros a resumed run does the same as the first
            parameter.grad = torch.zeros_like(parameter)

    def _network(self, start: torch.Generator) -> MlpField:
        c = self.config
        precision = torch.bfloat16 if c.precision == "bfloat16" else torch.float32
        field = MlpField(
            c.depth, c.width, c.position_frequencies, c.direction_frequencies, c.include_input, c.pi, c.view_directions,
            precision,
        )  # fmt: skip
        field.initialise(start)
        return field.to(self.device)

    @property
    def final(self) -> MlpField:
        """The network that draws the picture."""
        return list(self.networks.values())[-1]

    def parametrise(self, rays: Rays) -> Parametrised:
        encoded = self.final.encode_directions(rays.directions)
        if self.ndc is None:
            one = torch.ones_like(rays.near)
            return Parametrised(rays.origins, rays.directions, rays.near, rays.far, one, one.bool(), encoded)
        origins, directions, exists = self.ndc.rays(rays.origins, rays.directions)
        first, one = self.ndc.first(rays.origins), torch.ones_like(rays.near)
        return Parametrised(origins, directions, first, one, directions.norm(dim=-1), exists, encoded)

    def begin_step(self, step: int, steps: int | None) -> None:
        """Clear gradients and set the learning rate of the exponential decay."""
        rate = self.config.learning_rate * self.config.decay ** (step / (steps or self.config.decay_steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=False)

    @torch.no_grad()
    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return colours (P, K, 3): the trunk is evaluated once per point, and the view branch for each direction."""
        _, trunk = self.final.geometry(self.network_points(points))
        encoded = self.final.encode_directions(directions.to(self.device, torch.float32))
        return self.final.colors(trunk, encoded)

    @torch.no_grad()
    def density(self, points: Tensor) -> Tensor:
        return torch.relu(self.final.geometry(self.network_points(points))[0])

    def network_points(self, points: Tensor) -> Tensor:
        """Map world points (P, 3) to the networks' coordinates (P, 3)."""
        x = points.to(self.device, torch.float32)
        return x if self.ndc is None else self.ndc.point(x)

    def frozen(self) -> Self:
        copy = object.__new__(type(self))
        copy.__dict__ |= self.__dict__
        copy.networks = {name: deepcopy(net) for name, net in self.networks.items()}
        return copy

    def parameters(self) -> list[Tensor]:
        return [p for net in self.networks.values() for p in net.parameters()]

    def state(self) -> dict[str, Tensor]:
        state = {f"{name}.{k}": v for name, net in self.networks.items() for k, v in net.state_dict().items()}
        return state | adam_state(self.optimizer) | {"generator": self.generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        for name, net in self.networks.items():
            net.load_state_dict({k: state[f"{name}.{k}"] for k in net.state_dict()})
        load_adam(self.optimizer, self.parameters(), state)
        generator = state["generator"].cpu()
        if len(generator) == len(
            self.generator.get_state()
        ):  # a state from another kind of device does not fit: the generator then starts at the seed
            self.generator.set_state(generator)
