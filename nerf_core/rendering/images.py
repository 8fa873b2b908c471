"""Whole pictures: every pixel of a camera, row by row, in the method's tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method


def tiles(method: Method, camera: Camera, scene: Scene) -> Iterator[Rays]:
    """The camera's rays in row order, `method.tile` at a time: the full-resolution renderer's own division."""
    for start in range(0, camera.width * camera.height, method.tile):
        yield tile_rays(camera, scene, start, method.tile)


def tile_rays(camera: Camera, scene: Scene, start: int, count: int) -> Rays:
    """The rays of `count` pixels from `start` on, counted row by row."""
    flat = np.arange(start, min(start + count, camera.width * camera.height))
    return camera_rays(camera, scene.near, scene.far, np.stack([flat % camera.width, flat // camera.width], -1))


def render_camera(
    method: Method, camera: Camera, scene: Scene, progress: Callable[[int, int], None] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) float32 in [0, 1] and expected distance along the ray (H, W), NaN where nothing was hit.

    `progress(done, total)` is called after each tile, in pixels; what it raises cancels the picture.
    """
    total, parts = camera.width * camera.height, []
    for rays in tiles(method, camera, scene):
        parts.append(method.render(rays))
        if progress is not None:
            progress(min(len(parts) * method.tile, total), total)
    whole = Rendering.cat(parts)
    color = whole.color.clamp(0, 1).cpu().numpy().reshape(camera.height, camera.width, 3)
    return color, whole.depth.cpu().numpy().reshape(camera.height, camera.width)


def to_bytes(color: np.ndarray) -> np.ndarray:
    """sRGB-encoded [0, 1] → uint8, rounded to the nearest of the 256 levels."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)
