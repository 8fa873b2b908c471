"""Export pictures and films tile by tile, so that training and the window continue meanwhile."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method, aimed, traced
from nerf_core.rendering.export.requests import Export
from nerf_core.rendering.images import tiles
from nerf_core.rendering.modes import COLOR, shaded


class Job(ABC):
    """An export that is done in pieces of work.

    progress: how far the export is.
    """

    def __init__(self, method: Method, scene: Scene, file: Path, total: int) -> None:
        """Prepare the job; `advance` does the work.

        Args:
            method: the model; it must not be trained meanwhile. Callers pass a frozen copy.
            scene: its scene.
            file: the file to write.
            total: the number of pieces that `_pieces` yields.
        """
        self._method, self._scene = method, scene
        self.progress = Export(file, 0, total, None)
        self._work = self._pieces()
        self._began: float | None = None

    @abstractmethod
    def _pieces(self) -> Iterator[bool]:
        """Do the work and write the file. Yields after every piece."""

    def abort(self) -> None:
        """Stop, and delete files that are not complete."""
        self._work = iter(())

    def advance(self) -> bool:
        """Do one piece of work.

        Returns:
            Whether there is more to do; False once the file is written.

        Raises:
            UserError: the file cannot be written. The job then has failed and is aborted; so it is for other errors.
        """
        if self.progress.state != "running":
            return False
        self._began = self._began or time.perf_counter()
        try:
            running = next(self._work, None) is not None
        except BaseException:
            self.progress = replace(self.progress, state="failed")
            self.abort()
            raise
        done = self.progress.done + running
        left = (time.perf_counter() - self._began) / max(done, 1) * (self.progress.total - done)
        self.progress = replace(self.progress, done=done, seconds_left=left, state="running" if running else "done")
        return running

    def cancel(self) -> None:
        """Abort at the user's request."""
        self.progress = replace(self.progress, state="cancelled")
        self.abort()

    def _picture(self, camera: Camera, mode: str = COLOR) -> Iterator[np.ndarray | None]:
        """Render a camera's picture in a mode.

        Yields None after each tile, and at last the picture, (H, W, 3) float32.
        """
        parts, method = [], aimed(self._method, camera)
        for rays in tiles(method, camera, self._scene):
            if mode == COLOR:
                parts.append(method.render(rays).color.clamp(0, 1).cpu().numpy())
            else:
                parts.append(shaded(method, rays, traced(method, rays), mode))
            yield None
        yield np.concatenate(parts).reshape(camera.height, camera.width, 3)


def tile_count(method: Method, *cameras: Camera) -> int:
    """Return the number of tiles in the pictures of `cameras`: the pieces of work that a job needs for them."""
    return sum(-(-camera.width * camera.height // method.tile) for camera in cameras)
