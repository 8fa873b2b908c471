"""Pictures and films for keeping, a tile at a time, so that training and the window go on meanwhile."""

from __future__ import annotations

import io
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerf_core.cameras import Camera
from nerf_core.checkpoint import write_atomically
from nerf_core.errors import UserError
from nerf_core.messages import Export, ExportPath, ExportStill
from nerf_core.methods import Method
from nerf_core.render import tiles, to_bytes
from nerf_core.scene import Scene
from nerf_core.video import VideoWriter, write_png


class Job(ABC):
    """Renders with weights of its own, frozen when it began: training on does not change what it shows.

    `progress` counts tiles of the whole job.
    """

    def __init__(self, method: Method, scene: Scene, file: Path, cameras: tuple[Camera, ...]) -> None:
        self._method, self._scene = method, scene
        total = sum(-(-c.width * c.height // method.tile) for c in cameras)
        self.progress = Export(file, 0, total, None)
        self._work = self._pieces()
        self._began: float | None = None

    @abstractmethod
    def _pieces(self) -> Iterator[bool]:
        """Yields after every tile, and writes what it has made."""

    def abort(self) -> None:
        """Leave no file behind that is not whole."""
        self._work = iter(())

    def advance(self) -> bool:
        """Render one tile; False when all is written. Raises UserError when it cannot be."""
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

    def _picture(self, camera: Camera) -> Iterator[np.ndarray | None]:
        """The camera's picture, (H, W, 3) float32, as the last item; None before it, once for each tile."""
        parts = []
        for rays in tiles(self._method, camera, self._scene):
            parts.append(self._method.render(rays).color.clamp(0, 1).cpu().numpy())
            yield None
        yield np.concatenate(parts).reshape(camera.height, camera.width, 3)


class FilmJob(Job):
    """A camera path as an MP4, and PNG frames beside it if asked for. What is aborted leaves neither."""

    def __init__(self, method: Method, scene: Scene, command: ExportPath) -> None:
        if not command.cameras:
            raise UserError(f"{command.file}: a film needs at least one frame")
        if command.file.suffix.lower() != ".mp4":
            raise UserError(f"{command.file}: a film is written as MP4: name a .mp4 file")
        super().__init__(method, scene, command.file, command.cameras)
        self._command = command
        self._frames: list[Path] = []
        first = command.cameras[0]
        self._writer = VideoWriter(command.file, command.fps, first.width, first.height)

    def abort(self) -> None:
        super().abort()
        self._writer.abort()
        if self.progress.state == "done":
            return
        for frame in self._frames:
            frame.unlink(missing_ok=True)
        if self._frames:
            with suppress(OSError):  # other files lie there: they are not ours
                self._frames[0].parent.rmdir()
        self._frames.clear()

    def _pieces(self) -> Iterator[bool]:
        file = self._command.file
        for number, camera in enumerate(self._command.cameras):
            for color in self._picture(camera):
                if color is None:
                    yield True
                    continue
                frame = to_bytes(color)
                self._writer.add(frame)
                if self._command.frames:
                    self._frames.append(file.with_name(f"{file.stem}_frames") / f"{number:05d}.png")
                    write_png(self._frames[-1], frame)
        self._writer.close()


class StillJob(Job):
    """One picture at full resolution: .png, or .npy with float32 (H, W, 3) before rounding."""

    def __init__(self, method: Method, scene: Scene, command: ExportStill) -> None:
        if command.file.suffix.lower() not in (".png", ".npy"):
            raise UserError(f"{command.file}: a picture is written as .png or .npy")
        super().__init__(method, scene, command.file, (command.camera,))
        self._camera = command.camera

    def _pieces(self) -> Iterator[bool]:
        for color in self._picture(self._camera):
            if color is None:
                yield True
            elif self.progress.file.suffix.lower() == ".npy":
                data = io.BytesIO()
                np.save(data, color)
                write_atomically(self.progress.file, data.getvalue())
            else:
                write_png(self.progress.file, to_bytes(color))
