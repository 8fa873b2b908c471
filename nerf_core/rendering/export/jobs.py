"""Pictures and films for keeping, a tile at a time, so that training and the window go on meanwhile."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method, traced
from nerf_core.rendering.export.requests import Export
from nerf_core.rendering.images import tiles
from nerf_core.rendering.modes import COLOR, shaded


class Job(ABC):
    """Renders with weights of its own, frozen when it began: training on does not change what it shows.

    total: pieces of work that `_pieces` yields; `progress` counts them.
    """

    def __init__(self, method: Method, scene: Scene, file: Path, total: int) -> None:
        self._method, self._scene = method, scene
        self.progress = Export(file, 0, total, None)
        self._work = self._pieces()
        self._began: float | None = None

    @abstractmethod
    def _pieces(self) -> Iterator[bool]:
        """Yields after every piece of work, and writes what it has made."""

    def abort(self) -> None:
        """Leave no file behind that is not whole."""
        self._work = iter(())

    def advance(self) -> bool:
        """Do one piece of work; False when all is written. Raises UserError when it cannot be."""
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
        self.progress = replace(self.progress, state="cancelled")
        self.abort()

    def _picture(self, camera: Camera, mode: str = COLOR) -> Iterator[np.ndarray | None]:
        """The camera's picture in a mode, (H, W, 3) float32, as the last item; None before it, once for each tile."""
        parts = []
        for rays in tiles(self._method, camera, self._scene):
            if mode == COLOR:
                parts.append(self._method.render(rays).color.clamp(0, 1).cpu().numpy())
            else:
                parts.append(shaded(self._method, rays, traced(self._method, rays), mode))
            yield None
        yield np.concatenate(parts).reshape(camera.height, camera.width, 3)


def tile_count(method: Method, *cameras: Camera) -> int:
    """How many tiles the pictures of `cameras` take."""
    return sum(-(-camera.width * camera.height // method.tile) for camera in cameras)
