"""The words of the package.

R rays, S samples a ray, N images, H × W pixels; no trailing singleton axes.

| name | shape | meaning |
|---|---|---|
| origins, directions | (R, 3) | world; directions of unit length, from the camera outwards |
| near, far | (R,) | world distance along the ray between which samples lie |
| t, delta | (R, S) | world distance along the ray; what multiplies sigma (NDC length under NDC) |
| sigma, rgb | (R, S), (R, S, 3) | density in 1/unit of delta, ≥ 0; [0, 1], sRGB-encoded as in the photos |
| alpha, transmittance, weights | (R, S) | 1 − exp(−σδ); light left before the sample; their product, Σ ≤ 1 |
| color, opacity, depth | (R, 3), (R,), (R,) | with background; Σ weights; expected t, NaN where nothing was hit |
| c2w | (3, 4) | camera to world, OpenGL axes: x right, y up, looking along −z |
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

# Below this opacity a ray has hit nothing that a depth could be told of: less than one step of an 8-bit pixel.
EMPTY = 1 / 512


@dataclass(frozen=True)
class Rays:
    """R world-space rays and the stretch of each that may hold content."""

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return Rays(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, device: torch.device) -> Rays:
        return Rays(*(getattr(self, f.name).to(device) for f in fields(self)))

    def padded(self, count: int) -> Rays:
        """Repeat the last ray until there are `count`: renderer and probe then run chunks of one shape."""
        missing = count - len(self)
        if missing <= 0:
            return self
        return Rays(
            *(
                torch.cat([v, v[-1:].expand(missing, *v.shape[1:])])
                for v in (getattr(self, f.name) for f in fields(self))
            )
        )


@dataclass(frozen=True)
class Rendering:
    """What a pixel needs: colour over the background, opacity, expected depth (NaN where nothing was hit)."""

    color: Tensor
    opacity: Tensor
    depth: Tensor

    def to(self, device: torch.device) -> Rendering:
        return Rendering(*(getattr(self, f.name).to(device) for f in fields(Rendering)))

    @staticmethod
    def cat(parts: list[Rendering]) -> Rendering:
        return Rendering(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Rendering)))


@dataclass(frozen=True)
class Samples:
    """Everything that was composited along R rays in one pass, front to back: (R, S) each, rgb (R, S, 3).

    count: (R,) how many of its S samples each ray really has; the rest absorb nothing. None: all of them.
    """

    name: str
    t: Tensor
    delta: Tensor
    sigma: Tensor
    alpha: Tensor
    transmittance: Tensor
    weights: Tensor
    rgb: Tensor
    count: Tensor | None = None


@dataclass(frozen=True)
class Trace:
    """A rendering together with the passes that made it, coarse before fine."""

    rendering: Rendering
    passes: tuple[Samples, ...]
