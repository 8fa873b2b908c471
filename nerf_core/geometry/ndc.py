"""Normalised device coordinates of forward-facing captures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Ndc:
    """The frustum of normalised device coordinates: one reference camera at the origin, looking along −z.

    NeRF, appendix C (arXiv:2003.08934): with the near plane at z = −near, t′ ∈ [0, 1] is linear in disparity.
    far: the scene's far bound (z-depth), where exported distances of t′ → 1 are clamped.
    """

    width: int
    height: int
    focal: float
    near: float
    far: float

    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """World rays (R, 3) → NDC origins, NDC directions (not unit: t′ runs 0…1), and which rays (R,) exist.

        Only a ray that points to −z meets the frustum's far end; the others get a harmless stand-in.
        """
        import torch

        exists = directions[:, 2] < -1e-6  # parallel to the image plane: never reaches the near plane
        dz = torch.where(exists, directions[:, 2], -torch.ones_like(directions[:, 2]))
        shift = -(self.near + origins[:, 2]) / dz
        o = origins + shift[:, None] * directions
        sx, sy = 2 * self.focal / self.width, 2 * self.focal / self.height
        oz = -self.near
        o_ndc = torch.stack([-sx * o[:, 0] / oz, -sy * o[:, 1] / oz, torch.full_like(dz, 1 + 2 * self.near / oz)], -1)
        d_ndc = torch.stack(
            [
                -sx * (directions[:, 0] / dz - o[:, 0] / oz),
                -sy * (directions[:, 1] / dz - o[:, 1] / oz),
                torch.full_like(dz, -2 * self.near / oz),
            ],
            -1,
        )
        return o_ndc, d_ndc, exists

    def first(self, origins: Tensor) -> Tensor:
        """World origins (R, 3) → the t′ (R,) at which their rays begin: 0, or beyond the near plane the origin's own.

        Where world_t is 0: t′ / (1 − t′) = −(near + o_z) / near. What lies behind a camera that flew in is not seen.
        """
        beyond = ((-self.near - origins[:, 2]) / self.near).clamp(min=0)
        return beyond / (1 + beyond)

    def world_t(self, origins: Tensor, directions: Tensor, t_ndc: Tensor) -> Tensor:
        """t′ (R, S) → world distance (R, S), clamped where the ray leaves the scene's far bound.

        On the shifted ray t′ = 1 − o_z / (o_z + t d_z), hence t = (o_z / d_z) (1/(1 − t′) − 1) with o_z = −near.
        """
        shift, scale = self._along(origins, directions)
        t = t_ndc.clamp(max=1 - self.near / self.far)
        return shift + scale * (t / (1 - t))

    def _along(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """shift and scale (R, 1) of the world distance shift + scale · t′ / (1 − t′)."""
        import torch

        dz = torch.where(directions[:, 2] < -1e-6, directions[:, 2], -torch.ones_like(directions[:, 2]))
        return (-(self.near + origins[:, 2]) / dz)[:, None], (-self.near / dz)[:, None]

    def stretched(self, origins: Tensor, directions: Tensor, t: Tensor, delta: Tensor) -> Tensor:
        """World distances t (R, S) and lengths δ in NDC → the world distances (R, S) at which those lengths end."""
        shift, scale = self._along(origins, directions)
        ratio = (t - shift) / scale  # t′ / (1 − t′)
        length = self.rays(origins, directions)[1].norm(dim=-1, keepdim=True)
        return self.world_t(origins, directions, ratio / (1 + ratio) + delta / length)

    def point(self, world: Tensor) -> Tensor:
        """World points (..., 3) in front of the origin → NDC points (..., 3)."""
        import torch

        z = world[..., 2].clamp(max=-1e-6)  # the frustum has no points beside or behind its camera
        return torch.stack(
            [
                -2 * self.focal / self.width * world[..., 0] / z,
                -2 * self.focal / self.height * world[..., 1] / z,
                1 + 2 * self.near / z,
            ],
            -1,
        )
