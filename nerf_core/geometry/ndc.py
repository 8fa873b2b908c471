"""Normalised device coordinates (NDC) for forward-facing captures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


# In near planes. 1 − t′ is then 2⁻²⁰, sixteen steps of float32 under 1: what lies farther cannot be told from infinity.
FARTHEST = float(2**20)


@dataclass(frozen=True)
class Ndc:
    """The frustum of NDC: one reference camera at the origin that looks along −z (NeRF, appendix C, arXiv:2003.08934).

    t′ ∈ [0, 1] is linear in disparity, and t′ = 0 lies on the near plane z = −near.
    far: the scene's far bound (z-depth). Samples lie behind it too, up to infinity.
    """

    width: int
    height: int
    focal: float
    near: float
    far: float

    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map world rays to NDC.

        Returns:
            NDC origins (R, 3); NDC directions (R, 3), not of unit length, because t′ runs from 0 to 1; and which rays
            exist, bool (R,). Only a ray towards −z reaches the frustum's far end; the others get a harmless direction.
        """
        import torch

        exists = directions[:, 2] < -1e-6  # a ray parallel to the image plane never reaches the near plane
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
        """Return the t′ (R,) at which rays from world origins (R, 3) begin.

        It is 0, or, for a camera that has moved past the near plane, the t′ of its origin, so that nothing behind the
        camera is seen. There world_t is 0, hence t′ / (1 − t′) = −(near + o_z) / near.
        """
        beyond = ((-self.near - origins[:, 2]) / self.near).clamp(min=0)
        return beyond / (1 + beyond)

    def world_t(self, origins: Tensor, directions: Tensor, t_ndc: Tensor) -> Tensor:
        """Map t′ (R, S) to world distance (R, S).

        t′ = 1, which is infinity, becomes a depth of FARTHEST · near, whose place in NDC differs by no more than 2e-6.

        On the ray that starts at the near plane t′ = 1 − o_z / (o_z + t d_z), hence
        t = (o_z / d_z) (1/(1 − t′) − 1) with o_z = −near.
        """
        shift, scale = self._along(origins, directions)
        t = t_ndc.clamp(max=1 - 1 / FARTHEST)
        return shift + scale * (t / (1 - t))

    def _along(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return shift and scale (R, 1), where the world distance is shift + scale · t′ / (1 − t′)."""
        import torch

        dz = torch.where(directions[:, 2] < -1e-6, directions[:, 2], -torch.ones_like(directions[:, 2]))
        return (-(self.near + origins[:, 2]) / dz)[:, None], (-self.near / dz)[:, None]

    def stretched(self, origins: Tensor, directions: Tensor, t: Tensor, delta: Tensor) -> Tensor:
        """Return the world distances (R, S) at which intervals end that begin at t (R, S) and are δ long in NDC."""
        shift, scale = self._along(origins, directions)
        ratio = (t - shift) / scale  # t′ / (1 − t′)
        length = self.rays(origins, directions)[1].norm(dim=-1, keepdim=True)
        return self.world_t(origins, directions, ratio / (1 + ratio) + delta / length)

    def point(self, world: Tensor) -> Tensor:
        """Map world points (..., 3) in front of the origin to NDC points (..., 3)."""
        import torch

        z = world[..., 2].clamp(
            max=-1e-6
        )  # the frustum has no points beside or behind its camera; this keeps the division finite
        return torch.stack(
            [
                -2 * self.focal / self.width * world[..., 0] / z,
                -2 * self.focal / self.height * world[..., 1] / z,
                1 + 2 * self.near / z,
            ],
            -1,
        )
