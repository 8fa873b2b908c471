"""Rays, samples along them and what is rendered from them. All modules use these names and shapes.

R rays, S samples per ray, N images, H × W pixels; no trailing singleton axes.

| name | shape | meaning |
|---|---|---|
| origins, directions | (R, 3) | world; directions of unit length, from the camera outwards |
| near, far | (R,) | world distances along the ray; all samples lie between them |
| t, delta | (R, S) | world distance along the ray; length of the sample's interval (in NDC under NDC) |
| sigma, rgb | (R, S), (R, S, 3) | density ≥ 0 per unit of delta; radiance in [0, 1], sRGB-encoded as in the photos |
| alpha, transmittance, weights | (R, S) | 1 − exp(−σδ), or the method's law; light left before it; product, Σ ≤ 1 |
| color, opacity, depth | (R, 3), (R,), (R,) | over the background; Σ weights; expected t, NaN where nothing was hit |
| c2w | (3, 4) | camera to world, OpenGL axes: x right, y up, looking along −z |
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

# Below this opacity a ray has hit nothing and has no depth: it is less than one step of an 8-bit pixel.
EMPTY = 1 / 512


@dataclass(frozen=True)
class Rays:
    """R world-space rays, each with the interval [near, far] that may hold content."""

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
        """Repeat the last ray until there are `count`, so that renderer and probe run chunks of the same shape."""
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
    """The pixels of R rays: colour over the background, opacity, and expected depth (NaN where nothing was hit)."""

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
    """The samples that one pass composited along R rays, front to back: (R, S) each, rgb (R, S, 3).

    count: (R,) the number of samples that each ray really has; the others have density 0. None: all S.
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
    """A rendering with the samples of the passes that made it, coarse before fine."""

    rendering: Rendering
    passes: tuple[Samples, ...]
