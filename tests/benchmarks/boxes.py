"""Measure how near the depths of `voxels` come to the truth on a scene of matt boxes, which is known in closed form.

    python tests/benchmarks/boxes.py [--steps 1300] [--size 200] [--seed 0] [--set NAME=VALUE …]

Six boxes with textures, turned at random, stand before a white background. 60 training cameras around them see them.
Another seed makes another scene. Prints PSNR of the photos of 8 other cameras, and the median error of the pixels'
expected depth, with its sign (positive: too deep) and without, in scene units. A pixel without depth has the largest
error.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.rays import Rendering
from nerf_core.geometry.scene import Scene, View
from nerf_core.training.metrics import psnr
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

TRAIN, TEST = 60, 8
DISTANCE = 4.0  # of the cameras from the origin
SUPERSAMPLE = 2  # a photo's pixel is the mean of so many rays along each side


class Boxes(NamedTuple):
    """centers: (B, 3). turns: (B, 3, 3) rotations, of which a row is a box's axis. halves: (B, 3) half the sides."""

    centers: np.ndarray
    turns: np.ndarray
    halves: np.ndarray

    @staticmethod
    def of(rng: np.random.Generator, count: int = 6) -> Boxes:
        turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
        return Boxes(rng.uniform(-0.7, 0.7, (count, 3)), turns, rng.uniform(0.15, 0.45, (count, 3)))


def hit(boxes: Boxes, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (R, 3) from outside first meet a box: t (R,), or inf, and the colours there (R, 3), or white."""
    nearest, color = np.full(len(origins), np.inf), np.ones((len(origins), 3))
    for b, (center, turn, half) in enumerate(zip(*boxes, strict=True)):
        o, d = (origins - center) @ turn.T, directions @ turn.T
        enter = ((-np.sign(d) * half - o) / d).max(-1)
        leave = ((np.sign(d) * half - o) / d).min(-1)
        met = (enter < leave) & (enter > 0) & (enter < nearest)
        at = o[met] + enter[met, None] * d[met]
        waves = np.stack([np.sin(k * at + b + k).sum(-1) for k in (5.0, 9.0, 14.0)], -1)
        checks = (np.floor(5.0 * at + 0.013).sum(-1) % 2)[:, None]
        nearest[met], color[met] = enter[met], np.clip(0.45 + 0.1 * waves + 0.16 * (checks - 0.5), 0, 1)
    return nearest, color


def camera(rng: np.random.Generator, size: int) -> Camera:
    """A camera anywhere around the origin that looks at it, z up."""
    up = rng.uniform(-0.8, 0.9)
    azimuth = rng.uniform(0, 2 * np.pi)
    back = np.array([*(np.sqrt(1 - up**2) * np.array([np.cos(azimuth), np.sin(azimuth)])), up])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.column_stack([right, np.cross(back, right), back, DISTANCE * back])
    return Camera(size, size, 1.3 * size, 1.3 * size, size / 2, size / 2, pose)


def photographed(boxes: Boxes, rng: np.random.Generator, size: int) -> Scene:
    views = tuple(View(f"{k}.png", camera(rng, size)) for k in range(TRAIN + TEST))
    photos = []
    for view in views:
        rays = camera_rays(view.camera.resized(SUPERSAMPLE * size, SUPERSAMPLE * size), 0.1, 10.0)
        _, color = hit(boxes, rays.origins.double().numpy(), rays.directions.double().numpy())
        mean = color.reshape(size, SUPERSAMPLE, size, SUPERSAMPLE, 3).mean((1, 3))
        photos.append(np.round(mean * 65535).astype(np.uint16))
    splits = {"train": tuple(range(TRAIN)), "test": tuple(range(TRAIN, TRAIN + TEST))}
    return Scene(
        name="boxes", format="blender", views=views, photos=Photos.of(photos), splits=splits, near=2.0, far=6.0,
        background=(1.0, 1.0, 1.0), center=np.zeros(3), radius=1.5, up=np.array([0.0, 0.0, 1.0]), to_input=np.eye(4),
        synthetic=True,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1300)
    parser.add_argument(
        "--size", type=int, default=200, help="pixels along a photo's side; above 246, constants of large photos"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    boxes = Boxes.of(rng)
    scene = photographed(boxes, rng, args.size)
    trainer = Trainer(scene, RunSettings(method="voxels", changes=dict(word.split("=", 1) for word in args.set)))
    while trainer.step_count < args.steps:
        trainer.step()
    quality, errors = [], []
    for i in scene.split("test"):
        rays = camera_rays(scene.views[i].camera, scene.near, scene.far)
        drawn = Rendering.cat([trainer.method.render(rays)])
        truth = scene.images[i].astype(np.float32) / 65535
        quality.append(psnr(drawn.color.numpy().reshape(truth.shape), truth))
        t, _ = hit(boxes, rays.origins.double().numpy(), rays.directions.double().numpy())
        error = (drawn.depth.numpy() - t)[np.isfinite(t)]
        errors.append(np.where(np.isnan(error), scene.far - scene.near, error))
    error = np.concatenate(errors)
    print(
        f"after {args.steps} steps, {trainer.seconds:.0f} s: {np.mean(quality):.2f} dB; median error of depth "
        f"{np.median(error):+.4f}, without its sign {np.median(np.abs(error)):.4f}; a pixel is "
        f"{DISTANCE / (1.3 * args.size):.4f}"
    )


if __name__ == "__main__":
    main()
