"""The meshes that a warp moves: a picture as a surface in space."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nerf_core.live.messages import Preview

JUMP = (
    1.1  # ratio of far to near depth in a cell: a larger one is an edge with something behind it, not a slanted surface
)
# Along the longer side. Software GL takes 7 ms for 14,000 triangles: a sheet without edges has no more than it needs.
MESH_CELLS = 160  # fine enough for silhouettes
SHEET_CELLS = 50  # with 80, warped pictures of stride 4 had 2 to 4 % less error
BESIDE = 64  # pixels: as wide as a picture's texels at most
SMOOTH = 2  # texels around one over which a coarse picture averages its depth, at least
SOFT = 4  # the stride from which on a picture has no edges: warped cells that are torn apart would show as blocks


def warp_mesh(preview: Preview) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh over the picture: points (P, 6) float32 and triangles (T, 3) int32.

    A point is pixel x, y, z-depth, x, y of its colour, and how many pixels have one colour.

    A point beside an edge takes the mean depth of the hits around it, so that triangles reach past the edge; the
    fragment shader then cuts them at the exact texel. A triangle over a jump in depth covers the area that the motion
    uncovers. It has the colour of its farthest corner, because the uncovered surface lies behind. All of it has this
    colour, so it is trusted while it is narrow.

    A coarse picture (SOFT) is one smooth sheet instead, with what was not hit at the depth of the rest.
    """
    height, width = preview.depth.shape
    step = max(1, -(-max(width, height) // (MESH_CELLS if preview.stride < SOFT else SHEET_CELLS)))
    rows, columns = _lattice(height, step), _lattice(width, step)
    depth = preview.depth[np.ix_(rows, columns)].astype(np.float64)
    missing = ~np.isfinite(depth)
    if preview.stride >= SOFT:  # smooth, so that it does not fold
        depth = _depth_around(preview.depth, max(SMOOTH, step // 2), rows, columns)  # every texel counts
        missing = np.isnan(depth)
        if not missing.all():
            depth[missing] = np.median(depth[~missing])
    elif missing.any():
        depth = np.where(missing, _depth_around(preview.depth, step, rows, columns), depth)
    x, y = columns * preview.stride + 0.5, rows * preview.stride + 0.5
    x[0] = y[0] = 0  # the borders, because texel centres end before them
    x[-1], y[-1] = preview.camera.width, preview.camera.height
    grid = np.empty((len(rows), len(columns), 6), np.float32)
    grid[..., 0] = grid[..., 3] = x
    grid[..., 1] = grid[..., 4] = y[:, None]
    grid[..., 2], grid[..., 5] = depth, preview.stride
    points, triangles = grid.reshape(-1, 6), _triangles(len(rows), len(columns))
    a, b, c, d = depth[:-1, :-1], depth[:-1, 1:], depth[1:, :-1], depth[1:, 1:]
    far, near = (np.stack([each(each(b, c), a), each(each(b, c), d)]).ravel() for each in (np.maximum, np.minimum))
    solid = np.isfinite(far)
    jumps = solid & (far > JUMP * near) & (preview.stride < SOFT)
    beside = triangles[jumps]
    torn = points[beside]  # (J, 3, 6)
    torn[..., 3:5] = torn[np.arange(len(torn)), depth.ravel()[beside].argmax(-1), None, 3:5]
    torn[..., 5] = step * preview.stride
    own = len(points) + np.arange(3 * len(torn), dtype=np.int32).reshape(-1, 3)
    whole = triangles[solid & ~jumps]
    return np.concatenate([points, torn.reshape(-1, 6)]), np.concatenate([whole, own])


@lru_cache(maxsize=16)  # a window has one lattice for each stride
def _triangles(rows: int, columns: int) -> np.ndarray:
    """Two triangles for each cell of a lattice, (T, 3) int32: first all upper left ones, then all lower right ones."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    triangles.flags.writeable = False
    return triangles


def sheet(preview: Preview, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh for what was not hit, as `warp_mesh`: a rectangle at one depth, that of what is beside it.

    It reaches BESIDE pixels past the hits: the coarse picture below it smears outlines no farther, unless the camera
    recedes much.
    """
    hit, ends = np.isfinite(preview.depth), []
    for axis, size in ((0, preview.camera.width), (1, preview.camera.height)):
        first, last = np.flatnonzero(hit.any(axis))[[0, -1]] * preview.stride
        ends.append((max(first - BESIDE, 0), min(last + BESIDE, size)))
    ends = [(x, y) for y in ends[1] for x in ends[0]]
    points = np.array([(x, y, depth, x, y, preview.stride) for x, y in ends], np.float32)
    return points, _triangles(2, 2)


def _lattice(count: int, step: int) -> np.ndarray:
    """0, step, 2·step … and the last index. Even a single texel gives two of them, so that there is a cell."""
    return np.append(np.arange(0, max(count - 1, 1), step), count - 1)


def _depth_around(depth: np.ndarray, reach: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The mean depth of the hits within `reach` texels of some rows and columns, NaN where there are none.

    (h, w), (R,) and (C,) → (R, C).

    It is 1 / mean(1/z). Over the picture of a plane 1/z is linear, so that a plane stays a plane. The mean of z itself
    would bend it.
    """
    hit = np.isfinite(depth) & (depth > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.where(hit, 1 / depth, np.float32(0)).astype(np.float64)
    sums = [inverse, hit.astype(np.float64)]
    for axis, places in enumerate((rows, columns)):  # sums over rows, then only of these over columns
        length = depth.shape[axis]
        high, low = np.minimum(places + reach + 1, length), np.maximum(places - reach, 0)
        for i, values in enumerate(sums):
            total = np.empty([n + (a == axis) for a, n in enumerate(values.shape)])
            before, after = (total[0], total[1:]) if axis == 0 else (total[:, 0], total[:, 1:])
            before[...] = 0
            np.cumsum(values, axis=axis, out=after)
            sums[i] = total.take(high, axis) - total.take(low, axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sums[1] > 0.5, sums[1] / sums[0], np.nan)  # 0.5: these are counts, summed as floats
