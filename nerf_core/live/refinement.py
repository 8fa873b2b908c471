"""What to compute next of a picture that is wanted at once: pure logic, no clock, no torch.

A picture starts as a coarse grid of pixels (stride 32, say). Each level halves the stride, and its grid contains the
coarser one: those pixels are kept if the weights have not changed since. Within a level, pixels are computed from the
centre outwards.

A level is drawn with the weights of its beginning, whatever training does meanwhile: a picture whose pixels are of two
steps shows a seam. Young weights change before a fine level is done. While training goes on, the picture therefore
stays at the finest level that can be drawn in time, or returns to it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.modes import COLOR

COARSEST = 64
YOUNG = 0.75  # a picture is up to date if its weights have this share of the current steps
FRESH_SECONDS = 5.0  # the longest that a level may take while training goes on
PATIENCE = 2  # abandon a level after twice its time limit: the limit is an estimate


def first_stride(width: int, height: int, affordable: float) -> int:
    """The smallest power of two, at most COARSEST, at which the grid has no more than `affordable` pixels."""
    stride = 1
    while stride < COARSEST and -(-width // stride) * -(-height // stride) > affordable:
        stride *= 2
    return stride


class Refinement:
    """The progressive picture of one camera. born: the step at which the weights that draw it began to learn."""

    def __init__(self, camera: Camera, stamp: int, stride: int, quality: str, mode: str = COLOR, born: int = 0) -> None:
        self.camera, self.stamp, self.quality, self.mode, self.born = camera, stamp, quality, mode, born
        self.stride = self._first_stride = stride
        self.fresh = False  # whether anything was written since `image` was last called
        self.first_level_done = self._drawn_again = False
        shape = (-(-camera.height // stride), -(-camera.width // stride))
        self._color = np.zeros((*shape, 3), np.float32)
        self._depth = np.full(shape, np.nan, np.float32)
        self._step = np.zeros(shape, np.int64)
        self._known = np.zeros(shape, bool)
        self._queue = _ordered(~self._known)
        self._next = 0
        self._begun = 0, 0.0  # the level: at which step, when
        self._took: float | None = None  # seconds it took

    def advance(self, step: int, training: bool = False, now: float = 0.0) -> bool:
        """Choose what to draw next; False if nothing is left to do. now: seconds on any clock.

        A complete level is followed by the next finer one if that can be drawn in time, otherwise by itself. A level
        that takes too long is abandoned for a coarser one.
        The next level has four times the pixels, so four times as many steps will pass. The first level is drawn
        between two steps; while `training`, it is drawn once more to count the steps.
        """
        if self.begins:
            self._begun, self._took = (step, now), None
        begun, seconds = self._begun[0], now - self._begun[1]
        if not self.level_done:
            steps = step - begun
            late = not self._in_time(begun, steps / PATIENCE, seconds / PATIENCE)
            if training and late and self.stride < self._first_stride:
                part = self._next / len(self._queue)
                self._coarsen(step, steps / part, seconds / part)
                return self.advance(step, training, now)
            return True
        passed = step - int(self._step.min())
        self._took = seconds if self._took is None else self._took
        took = self._took if training else 0.0
        timed = bool(passed) or self._drawn_again or not training
        if self.stride > 1 and timed and self._in_time(step, 4 * passed, 4 * took):
            self._refine(step)
        elif timed and not passed:
            return False
        elif training and not self._in_time(begun, passed / PATIENCE, took / PATIENCE):
            self._coarsen(step, passed, took)
        else:
            self.begin_again()
        return self.advance(step, training, now)  # a picture of one texel gains none by halving

    def _in_time(self, step: int, steps: float, seconds: float) -> bool:
        """Whether a picture of the weights at `step` is still up to date after `steps` more steps and `seconds`."""
        age = step - self.born
        return age >= YOUNG * (age + steps) and seconds <= FRESH_SECONDS

    def begin_again(self) -> None:
        """Draw the whole level again."""
        self._drawn_again = True
        self._queue = _ordered(np.ones_like(self._known))
        self._next = 0

    @property
    def level_done(self) -> bool:
        return self._next >= len(self._queue)

    @property
    def cells_left(self) -> int:
        return len(self._queue) - self._next

    def coherent(self) -> bool:
        """Whether all pixels are of the same training step."""
        return int(self._step.min()) == int(self._step.max())

    @property
    def begins(self) -> bool:
        """Whether no pixel of the level has been drawn yet."""
        return self._next == 0

    def take(self, count: int) -> np.ndarray:
        """The next at most `count` cells (K, 2) to compute."""
        return self._queue[self._next : self._next + count]

    def pixels(self, cells: np.ndarray) -> np.ndarray:
        """Cells (row, column) → integer pixels (column, row) of the full picture."""
        return cells[:, ::-1] * self.stride

    def write(self, cells: np.ndarray, color: np.ndarray, depth: np.ndarray, step: int) -> None:
        """Colours (K, 3) and z-depths (K,) of the cells that `take` gave."""
        rows, columns = cells.T
        self._color[rows, columns], self._depth[rows, columns] = color, depth
        self._step[rows, columns], self._known[rows, columns] = step, True
        self._next += len(cells)
        self.first_level_done |= self.level_done
        self.fresh = True

    def _refine(self, step: int) -> None:
        stride = self.stride // 2
        shape = (-(-self.camera.height // stride), -(-self.camera.width // stride))
        known = np.zeros(shape, bool)
        known[::2, ::2] = True
        self._color = _doubled(self._color, shape)
        self._depth = np.repeat(np.repeat(self._depth, 2, 0), 2, 1)[: shape[0], : shape[1]]
        self._step = np.repeat(np.repeat(self._step, 2, 0), 2, 1)[: shape[0], : shape[1]]
        self._known, self.stride = known, stride
        # Old texels between new ones show as a grid of dots, so texels of earlier steps are drawn again.
        self._queue = _ordered(~known | (self._step < step))
        self._next = 0

    def _coarsen(self, step: int, steps: float, seconds: float) -> None:
        """Return to a level that can be drawn in time; at the coarsest, to the first."""
        skip = 1
        while self.stride < self._first_stride and not self._in_time(step, steps, seconds):
            self.stride, skip, steps, seconds = 2 * self.stride, 2 * skip, steps / 4, seconds / 4
        self._color, self._depth, self._step, self._known = (
            grid[::skip, ::skip].copy() for grid in (self._color, self._depth, self._step, self._known)
        )
        self.begin_again()

    def complete(self) -> bool:
        return self.stride == 1 and bool(self._known.all())

    def image(self) -> Preview:
        """The picture as it stands, once its first level is done and while it is `coherent`."""
        self.fresh = False
        rgba = np.full((*self._known.shape, 4), 255, np.uint8)
        rgba[..., :3] = to_bytes(self._color)
        return Preview(
            stamp=self.stamp,
            camera=self.camera,
            rgba=rgba,
            depth=self._depth.copy(),
            stride=self.stride,
            complete=self.complete(),
            step=int(self._step.min()),
            quality=self.quality,
            mode=self.mode,
        )


def _ordered(wanted: np.ndarray) -> np.ndarray:
    """The wanted cells (row, column) of a grid, nearest to the centre first."""
    cells = _outwards(*wanted.shape)
    return cells if wanted.all() else cells[wanted[cells[:, 0], cells[:, 1]]]


@lru_cache(maxsize=8)  # a window's levels come again with every view, and sorting a million cells takes 0.1 s
def _outwards(height: int, width: int) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width].astype(np.int32).reshape(2, -1)
    # doubled, so that a centre between two cells stays a whole number
    distance = (2 * rows - (height - 1)) ** 2 + (2 * columns - (width - 1)) ** 2
    return np.stack([rows, columns], -1)[np.argsort(distance, kind="stable")]


def _doubled(grid: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(h, w, 3) → `shape`: every second texel as it was, those between as the mean of their neighbours."""
    for axis in (0, 1):
        following = np.concatenate([np.take(grid, range(1, grid.shape[axis]), axis), np.take(grid, [-1], axis)], axis)
        grid = np.stack([grid, (grid + following) / 2], axis + 1).reshape(
            *grid.shape[:axis], 2 * grid.shape[axis], *grid.shape[axis + 1 :]
        )
    return np.ascontiguousarray(grid[: shape[0], : shape[1]])
