"""Render whole pictures: every pixel of a camera, row by row, in tiles of the method's size."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator

import numpy as np

from nerf_core.common.pieces import finished
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.view_rays import view_rays
from nerf_core.methods import Method, aimed


def tiles(method: Method, camera: Camera, scene: Scene) -> Iterator[Rays]:
    """Yield a camera's rays row by row, `method.tile` at a time, as `render_camera` divides them.

    Args:
        method: the model.
        camera: any camera.
        scene: the scene, for its bounds.
    """
    for start in range(0, camera.width * camera.height, method.tile):
        yield tile_rays(camera, scene, start, method.tile)


def tile_rays(camera: Camera, scene: Scene, start: int, count: int) -> Rays:
    """Return the rays of `count` pixels from pixel `start` on, counted row by row; fewer at the end of the picture.

    Their bounds are those of `view_rays`.
    """
    flat = np.arange(start, min(start + count, camera.width * camera.height))
    return view_rays(scene, camera, np.stack([flat % camera.width, flat // camera.width], -1))


def render_camera(
    method: Method, camera: Camera, scene: Scene, progress: Callable[[int, int], None] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Render a whole picture.

    Args:
        method: the model.
        camera: any camera; its width and height are those of the picture.
        scene: the model's scene, for its bounds.
        progress: called after each tile as (pixels done, pixels in all); it may raise to cancel.

    Returns:
        Colour (H, W, 3) float32 in [0, 1], sRGB-encoded, over the scene's background. Expected distance along the ray
        (H, W) float32 in world units, NaN where the ray hits nothing.
    """
    total = camera.width * camera.height

    def tell(share: float) -> None:
        if progress is not None:
            progress(round(share * total), total)

    return finished(rendering(method, camera, scene), tell)


def rendering(method: Method, camera: Camera, scene: Scene) -> Generator[float, None, tuple[np.ndarray, np.ndarray]]:
    """Do what `render_camera` does a tile at a time. Yields the share of the pixels that are done after each tile."""
    total, parts = camera.width * camera.height, []
    method = aimed(method, camera)
    for rays in tiles(method, camera, scene):
        parts.append(method.render(rays))
        yield min(len(parts) * method.tile, total) / total
    whole = Rendering.cat(parts)
    color = whole.color.clamp(0, 1).cpu().numpy().reshape(camera.height, camera.width, 3)
    return color, whole.depth.cpu().numpy().reshape(camera.height, camera.width)


def to_bytes(color: np.ndarray) -> np.ndarray:
    """Convert sRGB-encoded colours in [0, 1], of any shape, to uint8 by rounding. Others are clipped."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)
