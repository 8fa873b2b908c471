"""The loop that keeps normals from turning between neighbouring cells; for the loss see `turn` of `March`."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerf_core.common.jit.vectors import inlined

F = np.float32
FLAT, TURN_RAYS = F(1e-12), 4  # those of `voxel_kernels`


@inlined
def rise(rows: Any, corners: Any, at: Any) -> Any:
    """How the raw density rises over a cell along x, y and z: each the mean of four edges."""
    x, y, z = F(0), F(0), F(0)
    for c in range(8):
        v = F(0.25) * rows[corners[at + c] + 12]
        x += v if c & 4 else -v
        y += v if c & 2 else -v
        z += v if c & 1 else -v
    return x, y, z


@inlined
def touch(corners: Any, at: Any) -> Any:
    """Whether a sample's cell and that of the sample behind it are two that share a vertex. So they have one size."""
    if corners[at] == corners[at + 8]:
        return False
    shared = 0
    for c in range(8):
        for other in range(8):
            shared += corners[at + c] == corners[at + 8 + other]
    return shared > 0


@inlined
def add_turn(gradient: Any, corners: Any, at: Any, turn: Any, front: Any, behind: Any) -> None:
    """Add the gradient of the turn between a sample's cell and the cell of the sample behind it; see `rise` for both.

    With d = behind − front and its part p that is perpendicular to n, ∂/∂d of ½ ln(1 + |p|²) is p / (1 + |p|²), but for
    FLAT.
    """
    x, y, z = behind[0] - front[0], behind[1] - front[1], behind[2] - front[2]
    along_x, along_y, along_z = behind[0] + front[0], behind[1] + front[1], behind[2] + front[2]
    square = along_x * along_x + along_y * along_y + along_z * along_z
    part = (x * along_x + y * along_y + z * along_z) / (square + FLAT)
    x, y, z = x - part * along_x, y - part * along_y, z - part * along_z
    share = F(0.25 * TURN_RAYS) * turn / (F(1) + x * x + y * y + z * z)
    x, y, z = share * x, share * y, share * z
    for c in range(8):
        by = (x if c & 4 else -x) + (y if c & 2 else -y) + (z if c & 1 else -z)
        gradient[corners[at + c] + 12] -= by
        gradient[corners[at + 8 + c] + 12] += by
