"""A camera path as a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.rendering.export.jobs import Job, tile_count
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.video import VideoWriter, write_png


class FilmJob(Job):
    """A camera path as an MP4, and PNG frames beside it if asked for. What is aborted leaves neither."""

    def __init__(self, method: Method, scene: Scene, command: ExportPath) -> None:
        if not command.cameras:
            raise UserError(f"{command.file}: a film needs at least one frame")
        if command.file.suffix.lower() != ".mp4":
            raise UserError(f"{command.file}: a film is written as MP4: name a .mp4 file")
        super().__init__(method, scene, command.file, tile_count(method, *command.cameras))
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
