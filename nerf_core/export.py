"""A camera path becomes a film, a tile at a time, so that training and the window go on meanwhile."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nerf_core.messages import Export, ExportPath
from nerf_core.methods import Method
from nerf_core.render import tiles, to_bytes
from nerf_core.scene import Scene
from nerf_core.video import VideoWriter, write_png


class ExportJob:
    """Renders with weights of its own, frozen when it began: a film in which the scene does not change."""

    def __init__(self, method: Method, scene: Scene, command: ExportPath) -> None:
        self.progress = Export(command.file, 0, len(command.cameras), None)
        self._method, self._scene, self._command = method, scene, command
        first = command.cameras[0]
        self._writer = VideoWriter(command.file, command.fps, first.width, first.height)
        self._work = self._pieces()
        self._seconds = 0.0

    def advance(self) -> bool:
        """Render one tile; False when the film is finished. Raises UserError when it cannot be written."""
        begin = time.perf_counter()
        try:
            running = next(self._work, None) is not None
        except BaseException:
            self.progress = replace(self.progress, state="failed")
            self.abort()
            raise
        self._seconds += time.perf_counter() - begin
        return running

    def cancel(self) -> None:
        self.progress = replace(self.progress, state="cancelled")
        self.abort()

    def abort(self) -> None:
        """Leave no file behind that is not whole; PNG frames are whole one by one and stay."""
        self._writer.abort()
        self._work = iter(())

    def _pieces(self) -> Iterator[bool]:
        began = time.perf_counter()
        total = len(self._command.cameras)
        for number, camera in enumerate(self._command.cameras):
            parts = []
            for rays in tiles(self._method, camera, self._scene):
                parts.append(self._method.render(rays).color.cpu().numpy())
                yield True
            frame = to_bytes(np.concatenate(parts).reshape(camera.height, camera.width, 3))
            self._writer.add(frame)
            if self._command.frames:
                file = self._command.file
                write_png(file.with_name(f"{file.stem}_frames") / f"{number:05d}.png", frame)
            done = number + 1
            left = (time.perf_counter() - began) / done * (total - done)
            self.progress = replace(self.progress, done=done, seconds_left=left)
        self._writer.close()
        self.progress = replace(self.progress, state="done", seconds_left=0.0)
