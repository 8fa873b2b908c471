"""The inverse warps: where a point of space lies in the template. Both forms are decoded from the latent code."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.methods.neural_volumes.decoder import GAIN, Upsampler, initialise, leaky

POSE = 0.1  # a raw number of 1 scales, turns or moves by a tenth: a warp moves all of the scene, so it shall be slow
SMALLEST = 1e-3  # floor under the weights' sum, which is about K; a product of exponentials can come near 0


def lattice(side: int, like: Tensor) -> Tensor:
    """The points (D, D, D, 3) of a grid over the cube [−1, 1]³, as x, y, z; the first axis runs along z.

    like: a tensor that has the wanted type and device.
    """
    line = torch.linspace(-1, 1, side, dtype=like.dtype, device=like.device)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    return torch.stack([x, y, z], -1)


def rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices (K, 3, 3) of quaternions (K, 4), which are normalised: w, x, y, z."""
    w, x, y, z = functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


class AffineWarp(nn.Module):
    """A mixture of K affine warps (Sec. "Mixture of affine warps").

        W⁻¹(x) = Σ w_i(A_i(x)) A_i(x) / Σ w_i(A_i(x)),   A_i(x) = s_i ∘ (R_i (x − t_i))

    Each warp has a scale s (3), a rotation R, a translation t (3) and a weight volume w, all decoded from the latent
    code. They begin as the identity.
    """

    def __init__(self, latent: int, warps: int, side: int) -> None:
        super().__init__()
        self.warps, self.side = warps, side
        self.pose_hidden, self.pose = nn.Linear(latent, 128), nn.Linear(128, 10 * warps)
        self.weight_hidden, self.weight = nn.Linear(latent, 64), nn.Linear(64, warps * side**3)

    def initialise(self, generator: torch.Generator) -> None:
        for layer, gain in ((self.pose_hidden, GAIN), (self.pose, 0), (self.weight_hidden, GAIN), (self.weight, 1)):
            initialise(layer, generator, gain)

    def parts(self) -> list[Callable[[Tensor], Tensor]]:
        """The functions that turn a latent code (L,) into the warp (1, 3, D, D, D), to be applied in turn."""
        return [self.warp]

    def affine(self, code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return scales (K, 3), rotations (K, 3, 3) and translations (K, 3)."""
        raw = POSE * self.pose(leaky(self.pose_hidden(code))).view(self.warps, 10)
        quaternions = torch.cat([1 + raw[:, 3:4], raw[:, 4:7]], -1)  # about the identity
        return torch.exp(raw[:, :3]), rotations(quaternions), raw[:, 7:]

    def _warped(self, code: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points' places A_i(x) (K, P, 3) under each warp, and their weights there (K, P, 1)."""
        scale, rotation, translation = self.affine(code)
        weights = torch.exp(self.weight(leaky(self.weight_hidden(code)))).view(self.warps, 1, *[self.side] * 3)
        places = torch.einsum("kab,kpb->kpa", rotation, points - translation[:, None]) * scale[:, None]
        w = functional.grid_sample(weights, places[:, None, None], padding_mode="border", align_corners=True)
        return places, w.view(self.warps, -1, 1)

    def warp(self, code: Tensor) -> Tensor:
        places, w = self._warped(code, lattice(self.side, code).view(-1, 3))
        warped = (w * places).sum(0) / w.sum(0).clamp(min=SMALLEST)
        return warped.T.reshape(1, 3, *[self.side] * 3)

    def shares(self, code: Tensor, points: Tensor) -> Tensor:
        """Return how much each warp counts at points (P, 3) of the cube: (P, K), with sum 1."""
        w = self._warped(code, points)[1][..., 0].T
        return w / w.sum(-1, keepdim=True).clamp(min=SMALLEST)


class FieldWarp(Upsampler):
    """A warp that transposed convolutions decode directly, as the points' displacements. It begins as the identity."""

    def __init__(self, latent: int, width: int, side: int) -> None:
        super().__init__(latent, width, side, 3)

    def initialise(self, generator: torch.Generator, last: float = 0.0) -> None:
        super().initialise(generator, last)

    def parts(self) -> list[Callable[[Tensor], Tensor]]:
        return [*super().parts(), self._displaced]

    def _displaced(self, raw: Tensor) -> Tensor:
        points = lattice(self.side, raw).permute(3, 0, 1, 2)[None]
        return points + raw * (2 / self.side)  # a raw number of 1 moves by a voxel of the warp
