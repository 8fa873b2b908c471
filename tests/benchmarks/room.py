"""Measure what the voxel method learns of a room that is photographed from inside: are its walls walls, or fog?

    python tests/benchmarks/room.py [--steps 500] [--seed 0] [--set NAME=VALUE …]

The room is a box with textured walls, photographed by 40 cameras near its middle that look outwards; every 8th photo is
held out. The truth is known in closed form. Another seed makes another room. Prints PSNR of the held-out
photos and of as many training photos, the median error of expected depth, and which share of the pixels' weight lies
within 0.1 and 0.2 of the wall.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
import torch

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.training.metrics import psnr
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

SIZE, PHOTOS = (160, 120), 40


class Room(NamedTuple):
    """half: (3,) half its sides. waves, checks: how fine the walls' texture is."""

    half: np.ndarray
    waves: tuple[float, float, float]
    checks: float

    @staticmethod
    def of(seed: int) -> Room:
        if not seed:
            return Room(np.array([3.0, 2.5, 1.4]), (2.0, 5.0, 9.0), 2.5)
        rng = np.random.default_rng([seed, 1])
        waves = rng.uniform((1.0, 3.0, 7.0), (3.0, 7.0, 12.0)).tolist()
        return Room(rng.uniform(1.2, 3.5, 3), tuple(waves), rng.uniform(1.5, 3.5))


def wall(room: Room, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (R, 3) from inside meet the walls: t (R,), and the walls' colours there (R, 3)."""
    with np.errstate(divide="ignore"):
        t = ((np.sign(directions) * room.half - origins) / directions).min(-1)
    x = origins + t[:, None] * directions
    waves = np.stack([np.sin(k * x + k).sum(-1) for k in room.waves], -1)
    checks = (np.floor(room.checks * x + 0.013).sum(-1) % 2)[:, None]
    return t, np.clip(0.5 + 0.1 * waves + 0.12 * (checks - 0.5), 0, 1)


def camera(rng: np.random.Generator, room: Room) -> Camera:
    eye = rng.uniform(-0.35, 0.35, 3) * room.half
    yaw, pitch = rng.uniform(0, 2 * np.pi), rng.uniform(-0.35, 0.35)
    back = -np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    width, height = SIZE
    return Camera(
        width, height, 0.7 * width, 0.7 * width, width / 2, height / 2,
        np.column_stack([right, np.cross(back, right), back, eye]),
    )  # fmt: skip


def photographed(room: Room, seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    views = tuple(View(f"{k}.png", camera(rng, room)) for k in range(PHOTOS))
    photos = []
    for view in views:
        rays = camera_rays(view.camera, 0.1, 10.0)
        _, color = wall(room, rays.origins.double().numpy(), rays.directions.double().numpy())
        photos.append(np.round(color.reshape(SIZE[1], SIZE[0], 3) * 65535).astype(np.uint16))
    held = tuple(range(0, PHOTOS, 8))
    splits = {"train": tuple(i for i in range(PHOTOS) if i not in held), "test": held}
    return Scene(
        name="room", format="transforms", views=views, photos=Photos.of(photos), splits=splits, near=0.1, far=10.0,
        background=(0.0, 0.0, 0.0), center=np.zeros(3), radius=2.0, up=np.array([0.0, 0.0, 1.0]), to_input=np.eye(4),
        disparity=True,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    args = parser.parse_args()
    room = Room.of(args.seed)
    scene = photographed(room, args.seed)
    trainer = Trainer(scene, RunSettings(method="voxels", changes=dict(word.split("=", 1) for word in args.set)))
    while trainer.step_count < args.steps:
        trainer.step()
    quality = {}
    for split in ("test", "train"):
        values = []
        for i in scene.split(split)[: len(scene.split("test"))]:
            drawn = trainer.method.render(camera_rays(scene.views[i].camera, scene.near, scene.far)).color.numpy()
            values.append(psnr(drawn.reshape(SIZE[1], SIZE[0], 3), scene.images[i].astype(np.float32) / 65535))
        quality[split] = np.mean(values)
    errors, near = [], []
    for i in scene.split("test"):
        rays = camera_rays(scene.views[i].camera, scene.near, scene.far)
        trace = trainer.method.trace(rays)  # pyright: ignore[reportAttributeAccessIssue]: voxels can be traced
        truth, _ = wall(room, rays.origins.double().numpy(), rays.directions.double().numpy())
        t, weights = trace.passes[-1].t, trace.passes[-1].weights
        off = (t - torch.from_numpy(truth)[:, None]).abs()
        near.append([float((weights * (off < d)).sum() / weights.sum()) for d in (0.1, 0.2)])
        errors.append(trace.rendering.depth.numpy() - truth)
    share = np.mean(near, 0)
    print(
        f"after {args.steps} steps, {trainer.seconds:.0f} s: held-out {quality['test']:.2f} dB, training "
        f"{quality['train']:.2f} dB; median depth error {np.nanmedian(np.abs(np.concatenate(errors))):.3f}; "
        f"weight within 0.1 and 0.2 of the wall {share[0]:.0%}, {share[1]:.0%}"
    )


if __name__ == "__main__":
    main()
