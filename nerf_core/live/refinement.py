"""Choose what to compute next of a preview. This is pure logic without a clock and without torch.

A preview starts as a coarse grid of pixels, with a stride of 32 for example. Each level halves the stride, and its grid
contains the coarser one: those pixels are kept if the weights have not changed since. Within a level, pixels are
computed from the centre outwards.

A level is drawn with the weights of its beginning, even if training continues meanwhile, because a picture with pixels
of two steps shows a seam. Weights that began to learn recently change much before a fine level is done. So while
training continues, the preview stays at the finest level that can be drawn in time, or returns to it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.modes import COLOR

COARSEST = 64  # the largest stride
YOUNG = 0.75  # a picture is up to date if its weights have done at least this share of the current steps
FRESH_SECONDS = 5.0  # the longest that a level may take while training continues
PATIENCE = 2  # abandon a level after twice its time limit: the limit is an estimate


def first_stride(width: int, height: int, affordable: float) -> int:
    """Return the stride of the first level: the smallest power of two at which the grid is affordable.

    Args:
        width, height: size of the picture in pixels.
        affordable: the largest number of pixels that the grid may have. The stride is at most COARSEST even so.
    """
    stride = 1
    while stride < COARSEST and -(-width // stride) * -(-height // stride) > affordable:
        stride *= 2
    return stride


class Refinement:
    """The progressive picture of one camera.

    stride: distance between the pixels of the current level, in pixels of the full picture.
    fresh: whether pixels were written since `image` was last called.
    first_level_done: whether there is a whole picture to show.
    """

    def __init__(
        self,
        camera: Camera,
        stamp: int,
        stride: int,
        quality: str,
        mode: str = COLOR,
        born: int = 0,
        model: int = 0,
        caption: str = "",
    ) -> None:
        """Begin with the first level.

        Args:
            camera: the camera; its width and height are those of the full picture.
            stamp: the number of the view request; the picture carries it.
            stride: the stride of the first level, a power of two; see `first_stride`.
            quality: "fine" or "coarse"; see `Renderable.render`. The picture carries it.
            mode: the render mode. The picture carries it.
            born: the training step at which the weights that draw the picture began to learn.
            model: their number. The picture carries both.
            caption: what the picture shows, in words. The picture carries it.
        """
        self.camera, self.stamp, self.quality, self.mode = camera, stamp, quality, mode
        self.born, self.model, self.caption = born, model, caption
        self.stride = self._first_stride = stride
        self.fresh = False
        self.first_level_done = self._drawn_again = False
        shape = (-(-camera.height // stride), -(-camera.width // stride))
        self._color = np.zeros((*shape, 3), np.float32)
        self._depth = np.full(shape, np.nan, np.float32)
        self._step = np.zeros(shape, np.int64)
        self._known = np.zeros(shape, bool)
        self._queue = _ordered(~self._known)
        self._next = 0
        self._begun = 0, 0.0  # step and time at which the level began
        self._took: float | None = None  # seconds that the level took

    def advance(self, step: int, training: bool = False, now: float = 0.0) -> bool:
        """Choose what to draw next; `take` then gives its pixels.

        A complete level is followed by the next finer one if that can be drawn in time, otherwise by itself. The finer
        one has four times the pixels, so it takes four times as long and as many steps. A level that takes too long is
        abandoned for a coarser one.

        The first level is drawn between two training steps, so no time is known. While training, it is drawn a second
        time to measure how many steps pass.

        Args:
            step: the number of training steps done.
            training: whether training continues meanwhile.
            now: the time in seconds, on any clock.

        Returns:
            False if nothing is left to draw.
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
        return self.advance(step, training, now)  # a level of one pixel has no finer grid

    def _in_time(self, step: int, steps: float, seconds: float) -> bool:
        """Return whether a picture of the weights at `step` is up to date after `steps` more steps and `seconds`."""
        age = step - self.born
        return age >= YOUNG * (age + steps) and seconds <= FRESH_SECONDS

    def begin_again(self) -> None:
        """Draw the whole level again."""
        self._drawn_again = True
        self._queue = _ordered(np.ones_like(self._known))
        self._next = 0

    @property
    def level_done(self) -> bool:
        """Whether no pixel of the level is left to draw."""
        return self._next >= len(self._queue)

    @property
    def cells_left(self) -> int:
        """The number of pixels of the level that are left to draw."""
        return len(self._queue) - self._next

    def coherent(self) -> bool:
        """Return whether all pixels are of the same training step."""
        return int(self._step.min()) == int(self._step.max())

    @property
    def begins(self) -> bool:
        """Whether no pixel of the level has been drawn yet."""
        return self._next == 0

    def take(self, count: int) -> np.ndarray:
        """Return the next cells to compute, at most `count`: row and column in the level's grid, (K, 2)."""
        return self._queue[self._next : self._next + count]

    def pixels(self, cells: np.ndarray) -> np.ndarray:
        """Convert cells (K, 2), row and column, to integer pixels (K, 2), column and row in the full picture."""
        return cells[:, ::-1] * self.stride

    def write(self, cells: np.ndarray, color: np.ndarray, depth: np.ndarray, step: int) -> None:
        """Store computed pixels.

        Args:
            cells: (K, 2) what `take` returned, or its first K rows.
            color: (K, 3) in [0, 1], sRGB-encoded.
            depth: (K,) z-depths in world units; NaN where nothing was hit.
            step: the training step of the weights that drew them.
        """
        rows, columns = cells.T
        self._color[rows, columns], self._depth[rows, columns] = color, depth
        self._step[rows, columns], self._known[rows, columns] = step, True
        self._next += len(cells)
        self.first_level_done |= self.level_done
        self.fresh = True

    def _refine(self, step: int) -> None:
        """Begin the next finer level, with the pixels of the current one. New pixels are interpolated until drawn."""
        stride = self.stride // 2
        shape = (-(-self.camera.height // stride), -(-self.camera.width // stride))
        known = np.zeros(shape, bool)
        known[::2, ::2] = True
        self._color = _doubled(self._color, shape)
        self._depth = np.repeat(np.repeat(self._depth, 2, 0), 2, 1)[: shape[0], : shape[1]]
        self._step = np.repeat(np.repeat(self._step, 2, 0), 2, 1)[: shape[0], : shape[1]]
        self._known, self.stride = known, stride
        # Pixels of earlier steps between new ones would show as a grid of dots, so they are drawn again.
        self._queue = _ordered(~known | (self._step < step))
        self._next = 0

    def _coarsen(self, step: int, steps: float, seconds: float) -> None:
        """Return to the finest level that can be drawn in time, at the coarsest to the first.

        steps, seconds: what the current level takes. A coarser level takes a quarter of that.
        """
        skip = 1
        while self.stride < self._first_stride and not self._in_time(step, steps, seconds):
            self.stride, skip, steps, seconds = 2 * self.stride, 2 * skip, steps / 4, seconds / 4
        self._color, self._depth, self._step, self._known = (
            grid[::skip, ::skip].copy() for grid in (self._color, self._depth, self._step, self._known)
        )
        self.begin_again()

    def complete(self) -> bool:
        """Return whether every pixel of the full picture is drawn."""
        return self.stride == 1 and bool(self._known.all())

    def image(self) -> Preview:
        """Return the picture of the current level. Call it once the first level is done and if it is `coherent`."""
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
            model=self.model,
            born=self.born,
            caption=self.caption,
        )


def _ordered(wanted: np.ndarray) -> np.ndarray:
    """Return the cells (K, 2) that a mask (h, w) chooses, nearest to the centre first."""
    cells = _outwards(*wanted.shape)
    return cells if wanted.all() else cells[wanted[cells[:, 0], cells[:, 1]]]


@lru_cache(maxsize=8)  # every view has the same levels, and sorting a million cells takes 0.1 s
def _outwards(height: int, width: int) -> np.ndarray:
    """Return all cells of a grid (h · w, 2), row and column, nearest to the centre first."""
    rows, columns = np.mgrid[:height, :width].astype(np.int32).reshape(2, -1)
    # distances are doubled, so that a centre between two cells stays an integer
    distance = (2 * rows - (height - 1)) ** 2 + (2 * columns - (width - 1)) ** 2
    return np.stack([rows, columns], -1)[np.argsort(distance, kind="stable")]


def _doubled(grid: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Enlarge a grid (h, w, 3) to `shape` (2h or 2h − 1, 2w or 2w − 1). New cells are means of their neighbours."""
    for axis in (0, 1):
        following = np.concatenate([np.take(grid, range(1, grid.shape[axis]), axis), np.take(grid, [-1], axis)], axis)
        grid = np.stack([grid, (grid + following) / 2], axis + 1).reshape(
            *grid.shape[:axis], 2 * grid.shape[axis], *grid.shape[axis + 1 :]
        )
    return np.ascontiguousarray(grid[: shape[0], : shape[1]])
