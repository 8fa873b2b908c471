"""Tell whether a capture is forward-facing: whether all its rays look the way of its mean camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerf_core.geometry.camera import Camera

CANCELLED = 1e-3  # a shorter mean of unit vectors has no direction: the vectors point everywhere or against each other
BORDER = 33  # pixels checked along each side: a lens bends the side, so that its extreme may lie between the corners


def mean_camera(poses: np.ndarray) -> np.ndarray | None:
    """Return the mean camera (3, 4) of poses (N, 3, 4); None if the view directions or up vectors cancel out.

    Position, back and up are means; x = up × back and y = back × x (official LLFF `poses_avg`).
    """
    up, back, position = poses[:, :, 1:].mean(0).T
    right = np.cross(up, back)
    if min(np.linalg.norm(back), np.linalg.norm(right)) < CANCELLED:
        return None
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])


def turned_away(cameras: Sequence[Camera], back: np.ndarray) -> int:
    """Return the number of cameras with a ray that does not point against the unit vector `back` (3,).

    The map from the image plane to directions is convex, so that the rays at the picture's border are the extreme ones.
    """
    import torch

    from nerf_core.geometry.cameras import Cameras  # here, so that a Scene and what describes one load without torch

    u = np.linspace(0, 1, BORDER)
    sides = [np.stack(np.broadcast_arrays(x, y), -1) for x, y in ((u, 0), (u, 1), (0, u), (1, u))]
    border = np.concatenate(sides)
    sizes = np.array([(c.width - 1, c.height - 1) for c in cameras], dtype=np.float64)
    pixels = (border * sizes[:, None] + 0.5).reshape(-1, 2)
    index = torch.arange(len(cameras)).repeat_interleave(len(border))
    directions = Cameras(cameras, 1.0, 2.0).rays(index, torch.from_numpy(pixels)).directions.double().numpy()
    along = (directions @ back).reshape(len(cameras), -1)
    return int((~(along < -1e-6)).any(1).sum())  # the same limit as in `Ndc.rays`; NaN counts as turned away
