"""Small photos of a textured box on a textured floor, whose poses structure from motion can find."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays

SIZE = (320, 240)
HALF = np.array([0.7, 0.5, 0.6])  # half the box's sides; it stands on the floor z = −0.6


def arc(count: int = 8, degrees: float = 70.0, around: bool = True) -> list[Camera]:
    """Cameras on an arc that look at the box; around=False: one place, from which the camera is only turned."""
    cameras = []
    for k in range(count):
        angle = np.radians(degrees * (k / (count - 1) - 0.5))
        eye = np.array([3.2 * np.sin(angle), -3.2 * np.cos(angle), 1.2 + 0.1 * (k % 3)])
        aim = np.array([0.0, 0.0, -0.2])
        if not around:
            eye, aim = np.array([0.0, -3.2, 1.2]), np.array([1.6 * np.sin(angle), -0.5, -0.2])
        back = (eye - aim) / np.linalg.norm(eye - aim)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        c2w = np.column_stack([right, np.cross(back, right), back, eye])
        cameras.append(Camera(*SIZE, 330.0, 330.0, SIZE[0] / 2, SIZE[1] / 2, c2w))
    return cameras


def picture(camera: Camera, seed: int = 0, cells: float = 14) -> np.ndarray:
    """The photo of a camera, (H, W, 3) uint8. Another seed has other textures. cells: of a texture, on a unit."""
    rays = camera_rays(camera, 0.1, 20.0)
    o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        enter = (-np.sign(d) * HALF - o) / d
        leave = (np.sign(d) * HALF - o) / d
        floor = (-HALF[2] - o[:, 2]) / d[:, 2]
    t, face = enter.max(1), enter.argmax(1)
    box = (t < leave.min(1)) & (t > 0)
    t = np.where(box, t, np.where(floor > 0, floor, 20.0))
    x, surface = o + t[:, None] * d, np.where(box, face, 3)
    rng = np.random.default_rng(seed)
    shade = np.zeros(len(x))
    for which in range(4):
        texture = rng.uniform(size=(64, 64))
        on = surface == which
        u, v = np.delete(x[on], min(which, 2), 1).T * cells
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        shade[on] = texture[i % 64, j % 64]
    color = np.stack([shade, 0.2 + 0.6 * shade, 0.9 - 0.7 * shade], -1) * (1 - 0.12 * np.where(box, face, 0))[:, None]
    return np.rint(255 * np.clip(color, 0, 1)).astype(np.uint8).reshape(SIZE[1], SIZE[0], 3)


def write(folder: Path, cameras: list[Camera], seeds: list[int] | None = None) -> Path:
    """Write the photos of cameras into a new folder."""
    folder.mkdir(parents=True)
    for k, camera in enumerate(cameras):
        photo = picture(camera, seeds[k] if seeds else 0)
        Image.fromarray(photo).save(folder / f"photo {k}.png")
    return folder
