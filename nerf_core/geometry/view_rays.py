"""Rays of any camera, with the bounds that fit where it stands: those of the capture, or those of a free camera."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import torch

from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene

BINS = 8  # the bounds of a free camera's picture are computed at BINS + 1 pixels a side
FEW = 4  # parts, of a row or a column: what fills more is crossed by the rays of several corners
# The bounds computed last, because a picture's tiles share them. The weak reference keeps no scene in memory.
_last: list[tuple[weakref.ref[Scene], Camera, torch.Tensor]] = []


def view_rays(scene: Scene, camera: Camera, pixels: np.ndarray) -> Rays:
    """Return the rays of a camera through the centres of its pixels, with near and far that suit the camera.

    A camera of the capture has the capture's bounds. The rays of a free camera begin at its eye, or where they enter
    the space that training rays cross (`Coverage`). They end where they last leave that space, or at the capture's far
    bound in an unbounded scene if that is farther. A ray that crosses none of it in an object's scene has no length.
    Under NDC, rays begin at the near plane, or at the eye once it has moved past that plane.

    Args:
        scene: the scene.
        camera: any camera.
        pixels: (R, 2) integer column and row.
    """
    rays = camera_rays(camera, scene.near, scene.far, pixels)
    if scene.owns(camera):
        return rays
    if scene.ndc is not None:
        begin = scene.ndc.world_t(rays.origins, rays.directions, scene.ndc.first(rays.origins)[:, None])[:, 0]
        return replace(rays, near=begin.clamp(min=0).minimum(rays.far))
    near, far = _between(_bounds(scene, camera), camera, pixels).unbind(-1)
    return replace(rays, near=near, far=far)


def beginning(scene: Scene, camera: Camera, near: float) -> str:
    """Return in words why a camera's rays begin at the distance `near`, in world units, for the microscope."""
    if scene.owns(camera):
        return marked("the photos' near bound")
    if near == 0:
        return marked("the eye")
    return marked("the near plane of NDC") if scene.ndc is not None else marked("where photos begin to show the space")


def _bounds(scene: Scene, camera: Camera) -> torch.Tensor:
    """Return near and far at the corners of BINS × BINS parts of a picture: ((BINS + 1)², 2), row by row.

    Each corner has the widest bounds of itself and its neighbours, so that every ray between them is enclosed.
    """
    for known, of, bounds in _last:
        if known() is scene and of is camera:
            return bounds
    column, row = np.meshgrid(*(np.linspace(0, size - 1, BINS + 1) for size in (camera.width, camera.height)))
    rays = camera_rays(camera, scene.near, scene.far, np.stack([column.ravel(), row.ravel()], -1))
    near, far = rays.near.double().numpy(), rays.far.double().numpy()
    first, last, leave = scene.coverage.crossed(camera.c2w[:, 3], rays.directions.double().numpy())
    some, through = np.isfinite(first), np.isfinite(leave)
    if scene.synthetic:
        near, far = np.where(some, first, np.inf), np.where(some, last, -np.inf)
    else:
        near = np.where(some, first, np.where(through, leave, near))
        far = np.maximum(np.where(some, last, far), far)
    _add_small(scene, camera, near, far)
    near, far = _widest(near, np.minimum), _widest(far, np.maximum)
    none = ~(np.isfinite(near) & np.isfinite(far))
    end = rays.far.double().numpy()
    near, far = np.where(none, end, near), np.where(none, end, far)
    bounds = torch.from_numpy(np.stack([near, np.maximum(far, near)], -1)).float()
    _last[:] = [(weakref.ref(scene), camera, bounds)]
    return bounds


def _add_small(scene: Scene, camera: Camera, near: np.ndarray, far: np.ndarray) -> None:
    """Widen the bounds of corners by the covered cells in the parts around them, if these cells fill few parts.

    From far away all of them may lie between corners, whose rays then cross none.

    Args:
        scene, camera: of the picture.
        near, far: the bounds of the corners, ((BINS + 1)²,), row by row. They are changed.
    """
    if scene.coverage.encloses(camera.c2w[:, 3]):
        return  # quickly, as most cameras stand there
    centres, radius = scene.coverage.cells()
    pixels, depth = camera.project(centres)
    at = pixels * BINS / np.maximum((camera.width - 1, camera.height - 1), 1)
    if not len(centres) or depth.min() <= 0 or not (np.ptp(at, axis=0) < FEW).any():
        return
    distance = np.linalg.norm(centres - camera.c2w[:, 3], axis=-1)
    framed = ((at > -1) & (at < BINS + 1)).all(-1)  # a cell is smaller than a part
    column, row = np.clip(at[framed].astype(int), 0, BINS - 1).T
    for corner in (0, 1, BINS + 1, BINS + 2):
        place = row * (BINS + 1) + column + corner
        np.minimum.at(near, place, np.maximum(distance[framed] - radius, 0))
        np.maximum.at(far, place, distance[framed] + radius)


def _between(bounds: torch.Tensor, camera: Camera, pixels: np.ndarray) -> torch.Tensor:
    """Interpolate the bounds of corners at pixels (R, 2): (R, 2). In steps, they would show as squares in a picture.

    The four corners around a pixel each enclose every ray between them, and so does their mean.
    """
    at = torch.from_numpy(np.asarray(pixels) * BINS / np.maximum((camera.width - 1, camera.height - 1), 1)).float()
    low = at.long().clamp(max=BINS - 1)
    (x, y), (column, row) = (at - low).unbind(-1), low.unbind(-1)
    grid = bounds.view(BINS + 1, BINS + 1, 2)
    upper = torch.lerp(grid[row, column], grid[row, column + 1], x[:, None])
    lower = torch.lerp(grid[row + 1, column], grid[row + 1, column + 1], x[:, None])
    return torch.lerp(upper, lower, y[:, None])


def _widest(bound: np.ndarray, choose: np.ufunc) -> np.ndarray:
    """Return the extreme of each corner's bound and those of the eight corners around it."""
    padded = np.pad(bound.reshape(BINS + 1, BINS + 1), 1, mode="edge")
    rows = choose.reduce([padded[i : i + BINS + 1] for i in range(3)])
    return choose.reduce([rows[:, i : i + BINS + 1] for i in range(3)]).ravel()
