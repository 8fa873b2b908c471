"""Scenes of balls with photos and models in closed form, into which tests plant faults that must be found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.methods.nerf.method import Nerf
from nerf_core.rendering.images import render_camera

SOFT = 60.0  # how steeply density falls at a ball's rim, per world unit
WAVES = 11.0  # radians per world unit along each axis: a wave is about ten pixels long in the photos
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Ball:
    center: tuple[float, float, float]
    radius: float
    color: tuple[float, float, float]
    density: float = 80.0
    gloss: float = 0.0  # how much of the direction is added to the colour
    skin: float = 0.0  # half the thickness of a hollow ball's skin; 0: the ball is solid
    pattern: float = 0.0  # amplitude of a colour wave through space: a texture from which depth is learnt


class Balls(nn.Module):
    """The closed form with the interface of a network. Densities add up; colours are mixed in proportion to them."""

    def __init__(self, balls: tuple[Ball, ...]) -> None:
        super().__init__()
        self.balls = balls

    def encode_directions(self, directions: Tensor) -> Tensor:
        return directions

    def encode_positions(self, x: Tensor) -> Tensor:
        return x

    def _densities(self, x: Tensor) -> Tensor:
        parts = []
        for ball in self.balls:
            outside = (x - torch.tensor(ball.center).to(x)).norm(dim=-1) - ball.radius
            if ball.skin:
                outside = outside.abs() - ball.skin
            parts.append(ball.density * torch.sigmoid(-SOFT * outside))
        return torch.stack(parts, -1)

    def geometry(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self._densities(x).sum(-1) - 0.01, x  # the ReLU that follows sets densities under 0.01 to 0

    def color(self, trunk: Tensor, encoded: Tensor) -> Tensor:
        share = self._densities(trunk)
        share = share / share.sum(-1, keepdim=True).clamp(min=1e-9)
        colors = torch.tensor([ball.color for ball in self.balls]).to(share)
        gloss = torch.tensor([ball.gloss for ball in self.balls]).to(share)
        pattern = torch.tensor([ball.pattern for ball in self.balls]).to(share)
        waves = torch.sin(WAVES * trunk).prod(-1)
        return (share @ colors + (share @ gloss)[:, None] * encoded + (share @ pattern * waves)[:, None]).clamp(0, 1)

    def colors(self, trunk: Tensor, encoded: Tensor) -> Tensor:
        count = len(encoded)
        return self.color(trunk.repeat_interleave(count, 0), encoded.repeat(len(trunk), 1)).view(len(trunk), count, 3)

    def forward(self, x: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor]:
        raw, trunk = self.geometry(x)
        return raw, self.color(trunk, encoded)


def model_of(scene: Scene, *balls: Ball) -> Nerf:
    """The paper's method with `Balls` instead of its networks."""
    method = Nerf(scene, NerfConfig(depth=1, width=4, tile=256, coarse_samples=96, fine_samples=96), CPU, 0)
    method.networks = {name: Balls(balls) for name in method.networks}  # type: ignore[assignment]  # no MLP, by intent
    return method


def ring_scene(*balls: Ball, count: int = 24, size: int = 40) -> Scene:
    """A scene with photos of `balls` from `count` training views around the origin, at two heights and distance 4."""
    views = []
    for k in range(count):
        azimuth, height = 2 * np.pi * k / count, 0.4 if k % 2 else 1.4
        views.append(View(f"train/r_{k}.png", looking((3.7 * np.cos(azimuth), 3.7 * np.sin(azimuth), height), size)))
    empty = Photos.empty([(size, size)] * count)
    scene = Scene(
        name="balls", format="blender", views=tuple(views), photos=empty, splits={"train": tuple(range(count))},
        near=2.0, far=6.0, background=(1.0, 1.0, 1.0), center=np.zeros(3), radius=1.5, up=np.array([0.0, 0.0, 1.0]),
        to_input=np.eye(4), synthetic=True,
    )  # fmt: skip
    method = model_of(scene, *balls)
    photos = [np.round(render_camera(method, view.camera, scene)[0] * 65535).astype(np.uint16) for view in views]
    return replace(scene, photos=Photos.of(photos))


def looking(eye: tuple[float, float, float], size: int = 40) -> Camera:
    """A camera at `eye` that looks at the origin, z up."""
    back = np.array(eye) / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    c2w = np.column_stack([right, np.cross(back, right), back, eye])
    return Camera(size, size, 1.25 * size, 1.25 * size, size / 2, size / 2, c2w)
