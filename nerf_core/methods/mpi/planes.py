"""One multiplane image (MPI): where rays cross its planes, what they see there, and the gradient of what they see.

An MPI is a stack of D planes across the optical axis of a reference view, evenly spaced in disparity 1/z. Each is a
picture with opacity, RGBα, as the reference camera sees it (Zhou et al. 2018, arXiv:1805.09817, section 3.1). A ray
meets plane i at its depth z_i. This is the same map from picture to picture as warping the plane by its homography.

All planes' pictures are stored with a border of one texel. Its α is always 0, so that a plane fades out at its edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays

BORDER = 1  # texels around a stored plane
OUTSIDE = -10.0  # a position in texels that no plane covers
LEAST_PACE = 1e-6  # cosine to the axis of a ray that counts as parallel to the planes, as in `Ndc.rays`


class Crossings(NamedTuple):
    """Where R rays cross the planes of an MPI.

    at: (D, R, 2) column and row in texels, where a texel's centre lies at +0.5; OUTSIDE where a ray does not meet a
        plane in front of its origin.
    t: (D, R) world distances along the rays; not positive, or not finite, where a ray does not meet a plane.
    """

    at: Tensor
    t: Tensor


class Seen(NamedTuple):
    """What R rays see of the D planes of an MPI, whose colours come from G pictures; see `sharing`.

    alpha, transmittance, weights: (D, R) α_i, T_i = Π_{j<i} (1 − α_j) and w_i = T_i α_i, front to back.
    rgb: (G, 3, P, R) colours; where G · P > D, the last ones are of no plane.
    color: (3, R) Σ w_i c_i, not divided by the opacity.
    opacity: (R,) Σ w_i.
    """

    alpha: Tensor
    transmittance: Tensor
    weights: Tensor
    rgb: Tensor
    color: Tensor
    opacity: Tensor

    def colors(self) -> Tensor:
        """Return the colours of the planes, (D, R, 3)."""
        return self.rgb.permute(0, 2, 3, 1).flatten(0, 1)[: len(self.alpha)]


@dataclass(frozen=True)
class Stack:
    """The geometry of an MPI.

    view: the index of the reference view.
    width, height: texels of a plane, with the margin.
    focal, center: (2,) float64, in texels.
    rotation, position: (3, 3) and (3,) float64, the reference camera's axes and place in the world.
    depths: (D,) float64, z-depths from the reference camera, near to far.
    """

    view: int
    width: int
    height: int
    focal: Tensor
    center: Tensor
    rotation: Tensor
    position: Tensor
    depths: Tensor

    @staticmethod
    def of(
        view: int, camera: Camera, bounds: tuple[float, float], planes: int, most: int, margin: float,
        device: torch.device,
    ) -> Stack:  # fmt: skip
        """Lay the planes in front of a reference camera.

        Texels are the pixels of its photo, without its lens. A photo with a side longer than `most` is shrunk.

        Args:
            view: the index of the reference view.
            camera: its camera.
            bounds: z-depths of the first and the last plane.
            planes: their number D.
            most: the most texels along a side, without the margin.
            margin: what the planes reach beyond the photo on each side, as a share of that side.
            device: where the planes lie.
        """
        shrink = min(1.0, most / max(camera.width, camera.height))
        width, height = max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
        lens = camera.resized(width, height)
        aside = round(width * margin), round(height * margin)
        disparities = torch.linspace(1 / bounds[0], 1 / bounds[1], planes, dtype=torch.float64)
        return Stack(
            view,
            width + 2 * aside[0],
            height + 2 * aside[1],
            torch.tensor([lens.fx, lens.fy], dtype=torch.float64, device=device),
            torch.tensor([lens.cx + aside[0], lens.cy + aside[1]], dtype=torch.float64, device=device),
            torch.from_numpy(np.array(camera.c2w[:, :3], np.float64)).to(device),
            torch.from_numpy(np.array(camera.c2w[:, 3], np.float64)).to(device),
            (1 / disparities).to(device),
        )

    def points(self) -> Tensor:
        """Return the texels' places on the plane at depth 1, border included: (H + 2, W + 2, 3), in camera axes."""
        row = torch.arange(self.height + 2 * BORDER, device=self.focal.device) + 0.5 - BORDER
        column = torch.arange(self.width + 2 * BORDER, device=self.focal.device) + 0.5 - BORDER
        y, x = torch.meshgrid((self.center[1] - row) / self.focal[1], (column - self.center[0]) / self.focal[0],
                              indexing="ij")  # fmt: skip
        return torch.stack([x, y, -torch.ones_like(x)], -1)

    def crossings(self, rays: Rays) -> Crossings:
        """Return where R rays cross the planes.

        In the reference camera's axes a ray is o + t d, and plane i is z = −z_i. So t_i = (z_i + o_z) / −d_z, and the
        column is c_x + f_x (o_x + t_i d_x) / z_i: a straight line over the disparity 1/z_i. The row likewise.
        """
        o = (rays.origins.double() - self.position) @ self.rotation
        d = rays.directions.double() @ self.rotation
        forwards = -d[:, 2] > LEAST_PACE
        pace = 1 / torch.where(forwards, -d[:, 2], 1.0)
        slope = d[:, :2] * pace[:, None]  # per z-depth
        sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=o.device)  # rows run downwards
        far = self.center + self.focal * sign * slope
        shift = self.focal * sign * (o[:, :2] + o[:, 2:] * slope)  # per disparity
        at = far + shift / self.depths[:, None, None]
        t = (self.depths[:, None] + o[:, 2]) * pace
        met = forwards & (t > 0)
        at = torch.where(met[..., None], at, OUTSIDE)
        return Crossings(at.float(), torch.where(forwards, t, -1.0).float())

    def covers(self, at: Tensor) -> Tensor:
        """Return whether planes may be opaque at positions (..., 2), bool (...): they fade out over half a texel."""
        size = torch.tensor([self.width, self.height], device=at.device)
        return ((at > -0.5) & (at < size + 0.5)).all(-1)


def look(alpha: Tensor, color: Tensor, at: Tensor) -> Seen:
    """Look rays up in the planes of an MPI, bilinearly, and composite what they see.

    C = Σ_i c_i α_i Π_{j<i} (1 − α_j), from the nearest plane to the farthest: the over operator of Zhou et al. 2018,
    section 3.1, written from front to back.

    Args:
        alpha: (D, H + 2, W + 2) opacities with their border.
        color: (G, 3, H + 2, W + 2) colours with their border.
        at: (D, R, 2) where the rays cross the planes, in texels.
    """
    planes, rays = at.shape[:2]
    pictures, padding = len(color), len(color) * sharing(planes, len(color)) - planes
    size = torch.tensor([alpha.shape[2], alpha.shape[1]], device=at.device)
    place = (at + BORDER - 0.5) * (2 / (size - 1)) - 1  # texel centres at the corners of [−1, 1]²
    a = functional.grid_sample(alpha[:, None], place[:, None], align_corners=True)[:, 0, 0]
    place = functional.pad(place, (0, 0, 0, 0, 0, padding)).view(pictures, -1, rays, 2)
    rgb = functional.grid_sample(color, place, align_corners=True)
    left = torch.cumprod(1 - a, 0)
    transmittance = torch.cat([torch.ones_like(a[:1]), left[:-1]])
    weights = transmittance * a
    seen = (functional.pad(weights, (0, 0, 0, padding)).view(pictures, 1, -1, rays) * rgb).sum((0, 2))
    return Seen(a, transmittance, weights, rgb, seen, weights.sum(0))


def sharing(planes: int, pictures: int) -> int:
    """Return how many neighbouring planes share a picture: P = ⌈D / G⌉. Plane i has the colours of picture i // P."""
    return -(-planes // pictures)


def alpha_gradient(seen: Seen, gradient: Tensor, behind: Tensor) -> Tensor:
    """Return the gradient (D, R) of a loss with regard to the opacities that rays see.

    With g = ∂L/∂(C + T_end b), where b lies behind the last plane:
    ∂L/∂α_i = T_i g·c_i − (Σ_{j>i} w_j g·c_j + T_end g·b) / (1 − α_i). The division is safe, because no stored α exceeds
    `optimizer.OPAQUE`.

    Args:
        seen: what the rays see.
        gradient: (3, R) g.
        behind: (3, R) b.
    """
    along = (seen.rgb * gradient[:, None]).sum(1).flatten(0, 1)[: len(seen.alpha)]  # g·c_i
    carried = seen.weights * along
    end = (1 - seen.opacity) * (gradient * behind).sum(0)
    after = carried.flip(0).cumsum(0).flip(0) - carried + end
    return seen.transmittance * along - after / (1 - seen.alpha)


class Spread(NamedTuple):
    """How positions (R, 2) share the four texels around them: their flat indices (4R,) and bilinear weights (4, R)."""

    texel: Tensor
    share: Tensor

    @staticmethod
    def of(at: Tensor, width: int, height: int) -> Spread:
        """Return the texels of a plane with a border that is `width` × `height` texels large without it."""
        x = (at[:, 0] + BORDER - 0.5).clamp(0, width + 2 * BORDER - 1)
        y = (at[:, 1] + BORDER - 0.5).clamp(0, height + 2 * BORDER - 1)
        left, top = x.floor().clamp(max=width + 2 * BORDER - 2), y.floor().clamp(max=height + 2 * BORDER - 2)
        fx, fy = x - left, y - top
        row = width + 2 * BORDER
        first = (top * row + left).long()
        index = torch.cat([first, first + 1, first + row, first + row + 1])
        return Spread(index, torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]))

    def onto(self, values: Tensor, plane: Tensor) -> None:
        """Add values (R,) to the texels of a contiguous plane (H + 2, W + 2): the transpose of a bilinear look-up."""
        plane.view(-1).scatter_add_(0, self.texel, (self.share * values).view(-1))
