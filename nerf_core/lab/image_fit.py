"""Fit a photo with networks (x, y) → (r, g, b) that differ only in how they encode the coordinates.

The experiment of "Fourier features let networks learn high frequency functions in low dimensional domains" (Tancik et
al. 2020, arXiv:2006.10739), section 6 and appendix E.1. Every encoding is one formula with another matrix B of
frequencies, in cycles per picture:

    γ(v) = [sin(2πBv), cos(2πBv)],  v ∈ [0, 1)²

    none         γ(v) = v
    basic        B = the identity: one wave along each axis
    positional   B = 2ᵏ along each axis, k = 0 … L − 1. Up to signs this is Eq. 4 of NeRF (arXiv:2003.08934) for
                 p = 2v − 1, and L = 1 is the basic encoding. (Tancik et al. use 128 log-spaced frequencies for
                 each axis; these are NeRF's and the lecture's octaves.)
    gaussian     B has random entries of N(0, σ²): waves of all directions
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.common.configs import check_ranges, constant
from nerf_core.datasets.resample import average_rows
from nerf_core.methods.adam import Adam, adam_state, load_adam
from nerf_core.training.metrics import psnr

MAPPINGS = ("none", "basic", "positional", "gaussian")
CHANGEABLE = {"positional": "frequencies", "gaussian": "sigma"}  # the constant that `ImageFit.replace` may change
# Rows and columns of the training pixels are even, counted from 0, and those of the test pixels are odd: a test pixel
# lies in the middle of four training pixels. These are the paper's two grids (appendix E.1). The pixels of the other
# half, with one even and one odd number, are in neither.
TRAINING, TEST = (slice(0, None, 2), slice(0, None, 2)), (slice(1, None, 2), slice(1, None, 2))
HIDDEN = 3  # layers, as in the paper
BIAS = 0.01  # standard deviation of the first biases, as in the paper's code
TILES = {"cpu": 1024, "cuda": 65536}  # pixels of a picture that are computed at once
CPU = torch.device("cpu")


@dataclass(frozen=True)
class ImageConfig:
    """The constants of the experiment. They are the paper's for natural images unless their line says otherwise.

    L and σ by default suit 128 pixels; see `suiting`.
    """

    size: int = constant(
        128, "longest side of the photo in pixels; a larger one is averaged; the paper's are 512", least=4, most=4096
    )
    steps: int = constant(500, "optimiser steps of each network; the paper's 2000 see every pixel", least=1, most=10**7)
    batch: int = constant(
        1024, "random training pixels per step; the paper takes all in every step", least=1, most=2**22
    )
    width: int = constant(256, "units of a hidden layer", least=1, most=2**12)
    # float32 resolves a coordinate times 2¹⁵ to less than a hundredth of a cycle
    frequencies: int = constant(4, "frequencies 2^k along each axis of the positional encoding, L", least=1, most=16)
    sigma: float = constant(
        5.0, "standard deviation of the Gaussian encoding's frequencies in cycles per picture", most=2.0**15
    )
    features: int = constant(256, "Gaussian frequencies; each gives a sine and a cosine", least=1, most=2**14)
    learning_rate: float = constant(1e-3, "Adam's learning rate for positional and gaussian")
    plain_learning_rate: float = constant(1e-2, "Adam's learning rate for none and basic")

    def __post_init__(self) -> None:
        check_ranges(self)

    @classmethod
    def suiting(cls, size: int, **changes: Any) -> ImageConfig:
        """Return the constants for a photo of that size, with changes by name.

        For 512 pixels they are the paper's: L = 6 and σ = 10 cycles (appendix E.1). The training pixels, every second
        one, hold frequencies up to size / 4. Encodings whose frequencies come close to that limit fit the training
        pixels perfectly and draw noise between them: on the sample photo at 128 pixels, L = 6 tests 2.7 dB worse than
        "basic" after 2000 steps. So L = log₂(size / 8), whose highest frequency is size / 16, and σ is at most
        size / 25.6.
        """
        chosen = {"frequencies": max(1, round(math.log2(size / 8))), "sigma": min(10.0, size / 25.6)}
        return cls(**({"size": size} | chosen | changes))

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def fitted(photo: np.ndarray, size: int) -> np.ndarray:
    """Average a photo (H, W, 3) by area so that its longest side has `size` pixels; a smaller one stays as it is."""
    height, width = photo.shape[:2]
    share = min(1.0, size / max(height, width))
    rows, columns = max(1, round(height * share)), max(1, round(width * share))
    small = average_rows(np.asarray(photo, np.float32), rows, lambda block: block)
    return average_rows(small.transpose(1, 0, 2), columns, lambda block: block).transpose(1, 0, 2).copy()


def coordinates(height: int, width: int) -> Tensor:
    """Return v = (column, row) / max(H, W) of all pixels, (H·W, 2) in [0, 1)², row by row; pixels are square."""
    v = torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1)
    return v.reshape(-1, 2).to(torch.float32) / max(height, width)


def frequencies(name: str, config: ImageConfig, normal: Tensor) -> Tensor:
    """Return the matrix B (F, 2) of a mapping, in cycles per picture; F = 0 for "none".

    Args:
        name: one of MAPPINGS.
        config: its constants.
        normal: (features, 2) draws of N(0, 1): another σ scales the same ones.
    """
    if name == "none":
        return torch.empty(0, 2)
    if name == "gaussian":
        return config.sigma * normal
    octaves = torch.exp2(torch.arange(1 if name == "basic" else config.frequencies, dtype=torch.float32))
    return torch.cat([octaves[:, None] * axis for axis in torch.eye(2)])


def encode(v: Tensor, b: Tensor) -> Tensor:
    """Return γ(v) = [sin(2πBv), cos(2πBv)] (P, 2F) at v (P, 2) for B (F, 2); v itself if F = 0."""
    if len(b) == 0:
        return v
    angles = (2 * math.pi) * (v @ b.T)
    return torch.cat([torch.sin(angles), torch.cos(angles)], -1)


def network(inputs: int, width: int, generator: torch.Generator) -> nn.Sequential:
    """Return the paper's network: three hidden ReLU layers, and a sigmoid for the colour.

    Weights are Glorot-normal and biases N(0, 0.01²), as in its code. From the bare coordinates (2 inputs) to colours it
    has 133,123 parameters at a width of 256.
    """
    sizes = [inputs, *[width] * HIDDEN, 3]
    layers: list[nn.Module] = []
    for i, o in pairwise(sizes):
        layer = nn.Linear(i, o)
        with torch.no_grad():
            layer.weight.normal_(0, (2 / (i + o)) ** 0.5, generator=generator)
            layer.bias.normal_(0, BIAS, generator=generator)
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1], nn.Sigmoid())


class _Learner:
    """One mapping's network with its optimiser, its own random generator, and the number of steps that it has made."""

    def __init__(self, name: str, config: ImageConfig, seed: int, device: torch.device) -> None:
        start = torch.Generator().manual_seed(seed)
        self.b = frequencies(name, config, torch.randn(config.features, 2, generator=start)).to(device)
        self.net = network(2 * len(self.b) or 2, config.width, start).to(device)
        rate = config.plain_learning_rate if name in ("none", "basic") else config.learning_rate
        self.optimizer = Adam(self.net.parameters(), lr=rate)
        self.generator = torch.Generator().manual_seed(seed + 1)  # all mappings draw the same batches
        self.steps = 0

    def colors(self, v: Tensor) -> Tensor:
        return self.net(encode(v, self.b))

    def state(self) -> dict[str, Tensor]:
        return {
            **self.net.state_dict(), **adam_state(self.optimizer), "b": self.b,
            "generator": self.generator.get_state(), "steps": torch.tensor(self.steps),
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        if state["b"].shape != self.b.shape:
            raise ValueError(f"the state has {len(state['b'])} frequencies, the network {len(self.b)}")
        self.net.load_state_dict({name: state[name] for name in self.net.state_dict()})
        load_adam(self.optimizer, list(self.net.parameters()), state)
        self.b = state["b"].to(self.b)
        self.generator.set_state(state["generator"].cpu())
        self.steps = int(state["steps"])


class ImageFit:
    """Networks of all MAPPINGS that learn the same photo. One thread owns it.

    photo: (H, W, 3) float32 in [0, 1], sRGB-encoded: what the networks learn, averaged to `config.size`.
    steps: how many optimiser steps each mapping has made, by name.

    A mapping learns the same whatever the others do: the order of steps does not matter. On one processor the same seed
    and number of threads give the same numbers bit for bit.
    """

    def __init__(self, photo: np.ndarray, config: ImageConfig, seed: int, device: torch.device = CPU) -> None:
        if photo.ndim != 3 or photo.shape[2] != 3 or min(photo.shape[:2]) < 2:
            raise ValueError(f"expected a photo (H, W, 3) of at least 2 × 2 pixels, got {photo.shape}")
        self.config, self.seed, self.device = config, seed, device
        self.photo = fitted(photo, config.size)
        height, width = self.photo.shape[:2]
        self._v = coordinates(height, width).to(device)
        self._colors = torch.from_numpy(self.photo).reshape(-1, 3).to(device)
        self._training = torch.arange(height * width).reshape(height, width)[TRAINING].flatten()
        self._learners = {name: _Learner(name, config, seed, device) for name in MAPPINGS}

    @property
    def steps(self) -> dict[str, int]:
        return {name: learner.steps for name, learner in self._learners.items()}

    def parameters(self, name: str) -> int:
        """Return the number of parameters of a mapping's network."""
        return sum(p.numel() for p in self._learners[name].net.parameters())

    def step(self, *names: str) -> dict[str, float]:
        """Make one optimiser step of these mappings, or of all: Adam on the mean squared error of a batch.

        One mapping's step is a piece of work of about 5 to 15 ms on one core at the default constants.

        Returns:
            The error of each batch before its step, by name.
        """
        return {name: self._step(self._learners[name]) for name in names or MAPPINGS}

    def _step(self, learner: _Learner) -> float:
        count, batch = len(self._training), self.config.batch
        chosen = self._training
        if batch < count:
            chosen = chosen[torch.randint(count, (batch,), generator=learner.generator)]
        chosen = chosen.to(self.device)
        loss = functional.mse_loss(learner.colors(self._v[chosen]), self._colors[chosen])
        learner.optimizer.zero_grad()
        loss.backward()
        learner.optimizer.step()
        learner.steps += 1
        return float(loss.detach())

    @torch.no_grad()
    def picture(self, name: str, yield_callback: Callable[[], None] = lambda: None) -> np.ndarray:
        """Return what a mapping's network has learned, (H, W, 3) float32 in [0, 1].

        Args:
            name: the mapping.
            yield_callback: called after each tile, about 5 ms of work on one core. It may raise to give up the picture.
        """
        learner, tiles = self._learners[name], []
        for v in self._v.split(TILES[self.device.type]):
            tiles.append(learner.colors(v).cpu())
            yield_callback()
        return torch.cat(tiles).reshape(self.photo.shape).numpy()

    def psnr(self, name: str, picture: np.ndarray | None = None) -> tuple[float, float]:
        """Return the PSNR in dB over the training pixels and over the test pixels; see TRAINING.

        Args:
            name: the mapping.
            picture: what `picture(name)` returned, to save drawing it again.
        """
        shown = self.picture(name) if picture is None else picture
        return psnr(shown[TRAINING], self.photo[TRAINING]), psnr(shown[TEST], self.photo[TEST])

    def replace(self, name: str, value: float) -> None:
        """Start a mapping again with another value of its constant: L of "positional", σ of "gaussian"."""
        constant = CHANGEABLE[name]
        self.config = replace(self.config, **{constant: value})
        self._learners[name] = _Learner(name, self.config, self.seed, self.device)

    def state(self) -> dict[str, Tensor]:
        """Return networks, optimisers, random state and the changed constants by name, for a file."""
        state = {f"{name}.{key}": v for name, one in self._learners.items() for key, v in one.state().items()}
        return state | {c: torch.tensor(getattr(self.config, c), dtype=torch.float64) for c in CHANGEABLE.values()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`.

        Raises:
            KeyError, RuntimeError, ValueError: it does not fit. The networks stay as they are.
        """
        config = replace(self.config, frequencies=int(state["frequencies"]), sigma=float(state["sigma"]))
        learners = {name: _Learner(name, config, self.seed, self.device) for name in MAPPINGS}
        for name, learner in learners.items():
            prefix = f"{name}."
            learner.load_state({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        self.config, self._learners = config, learners
