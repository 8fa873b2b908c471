"""The world of Flatland: discs and boxes with a density and colours, and its exact photos.

The world lies in a disc of radius 1 around the origin. A photo of it is one line of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_core.lab.flatland.rays import PIXELS, FlatRays
from nerf_core.volume.compositing import absorb, composite

EDGE = 0.05  # width of the ramp between two colours, and between outside and inside: a photo's pixel is 0.04 wide there
FINE = 256  # samples of a true ray: δ = 0.008 at most, a sixth of a ramp
BACKGROUND = (0.06, 0.07, 0.09)
SOLID = 40.0  # density of what lets nothing through: 0.1 of it absorb 98 %
LIGHT = (-0.6, 0.8)  # the direction towards the lamp that the glossy disc mirrors

Paint = Callable[[Tensor, Tensor], Tensor]  # offsets from the shape's centre in its axes (P, 2), view (P, 2) → (P, 3)


def _plain(*rgb: float) -> Paint:
    return lambda q, d: q.new_tensor(rgb).expand(len(q), 3)


def _across(border: Tensor, first: tuple[float, ...], second: tuple[float, ...]) -> Tensor:
    """Return the colours (P, 3) on both sides of a border at signed distances (P,), with a ramp over `EDGE`."""
    share = (0.5 + border / EDGE).clamp(0, 1)[:, None]
    return share * border.new_tensor(first) + (1 - share) * border.new_tensor(second)


def _ball(q: Tensor, d: Tensor) -> Tensor:
    """Four sectors, red and cream."""
    border = q[:, 0] * q[:, 1] / q.norm(dim=-1).clamp(min=1e-6)  # r sin 2φ / 2
    return _across(border, (0.86, 0.20, 0.18), (0.97, 0.90, 0.72))


def _stripes(q: Tensor, d: Tensor) -> Tensor:
    """Three stripes, blue, yellow and blue."""
    return _across(q[:, 0].abs() - 0.08, (0.16, 0.38, 0.82), (0.98, 0.80, 0.20))


def _glossy(q: Tensor, d: Tensor) -> Tensor:
    """Violet, with the mirrored lamp: Phong's law, (r·l)⁴ with r the mirrored view and l the lamp's direction."""
    normal = q / q.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    mirrored = d - 2 * (d * normal).sum(-1, keepdim=True) * normal
    shine = (mirrored @ q.new_tensor(LIGHT)).clamp(0, 1)[:, None] ** 4
    base = q.new_tensor((0.42, 0.22, 0.62))
    return base + shine * (1 - base)


@dataclass(frozen=True)
class Shape:
    """A disc or a box.

    center: (x, y).
    half: half of its sides; of a disc, its radius twice.
    sigma: its density inside, per unit of length.
    paint: its colours; see `Paint`.
    degrees: by how much it is turned counter-clockwise.
    disc: whether it is a disc.
    """

    center: tuple[float, float]
    half: tuple[float, float]
    sigma: float
    paint: Paint
    degrees: float = 0.0
    disc: bool = False

    def offsets(self, p: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Return the offsets of points from the centre, along the shape's own axes."""
        c, s = math.cos(math.radians(self.degrees)), math.sin(math.radians(self.degrees))
        return (p - p.new_tensor(self.center)) @ p.new_tensor([[c, -s], [s, c]])

    def density(self, p: Float[Tensor, "P 2"]) -> Float[Tensor, " P"]:
        """Return σ at points: `sigma` inside, 0 outside, and linear between over `EDGE`.

        The ramp lies half inside and half outside, so that the integral across a box is exactly σ times its width.
        """
        q = self.offsets(p)
        if self.disc:
            distance = q.norm(dim=-1) - self.half[0]
        else:
            away = q.abs() - q.new_tensor(self.half)
            distance = away.clamp(min=0).norm(dim=-1) + away.amax(-1).clamp(max=0)
        return self.sigma * (0.5 - distance / EDGE).clamp(0, 1)


def _disc(x: float, y: float, radius: float, sigma: float, paint: Paint) -> Shape:
    return Shape((x, y), (radius, radius), sigma, paint, disc=True)


SHAPES = (
    _disc(-0.38, 0.36, 0.28, SOLID, _ball),
    Shape((0.42, -0.40), (0.24, 0.24), SOLID, _stripes, 20.0),
    _disc(0.46, 0.40, 0.22, SOLID, _glossy),
    Shape((-0.50, -0.42), (0.30, 0.035), SOLID, _plain(0.20, 0.70, 0.36), -32.0),
    _disc(-0.02, -0.04, 0.15, 4.0, _plain(0.96, 0.55, 0.20)),  # a cloud that lets through a third of the light
)


class World:
    """Shapes over a background."""

    def __init__(self, shapes: tuple[Shape, ...] = SHAPES, background: tuple[float, float, float] = BACKGROUND) -> None:
        self.shapes, self.background = shapes, torch.tensor(background)

    def density(self, p: Float[Tensor, "P 2"]) -> Float[Tensor, " P"]:
        """Return σ at points (P, 2), per unit of length."""
        return torch.stack([shape.density(p) for shape in self.shapes]).sum(0)

    def radiance(
        self, p: Float[Tensor, "P 2"], d: Float[Tensor, "P 2"]
    ) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 3"]]:
        """Return σ and colour at points, seen in directions d of unit length (P, 2).

        Where shapes overlap, each colour counts by its density.
        """
        densities = [shape.density(p) for shape in self.shapes]
        sigma, rgb = torch.stack(densities).sum(0), torch.zeros(len(p), 3)
        for shape, own in zip(self.shapes, densities, strict=True):
            inside = own.nonzero().squeeze(-1)  # most of a ray is empty
            share = (own[inside] / sigma[inside])[:, None]
            rgb[inside] += share * shape.paint(shape.offsets(p[inside]), d[inside])
        return sigma, rgb

    def colors(self, rays: FlatRays) -> Float[Tensor, "R 3"]:
        """Return the exact colours of rays: NeRF Eq. 3 over `FINE` samples at the middles of equal intervals."""
        found = []
        for part in rays.split(PIXELS):
            delta = ((part.far - part.near) / FINE)[:, None]
            t = part.near[:, None] + delta * (torch.arange(FINE) + 0.5)
            sigma, rgb = self.radiance(part.points(t), part.directions.repeat_interleave(FINE, 0))
            *_, weights = absorb(sigma.view(t.shape), delta.expand_as(t))
            found.append(composite(weights, rgb.view(*t.shape, 3), self.background)[0])
        return torch.cat(found)
