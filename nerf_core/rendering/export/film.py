"""Export a camera path as a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.common.files import Part, unwritable
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.rendering.export.jobs import Job, tile_count
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.video import VideoWriter, write_png


class FilmJob(Job):
    """A camera path as an MP4, and PNG frames beside it if asked for.

    Files of the same names are replaced once the film is whole. If the job is aborted, they stay as they were.
    """

    def __init__(self, method: Method, scene: Scene, command: ExportPath) -> None:
        """Start the video.

        Args:
            method: the model; it must not be trained meanwhile.
            scene: its scene.
            command: cameras, frame rate and file.

        Raises:
            UserError: there are no cameras, the file is not named .mp4 or cannot be written, or ffmpeg is missing.
        """
        if not command.cameras:
            raise UserError(f"{command.file}: a film needs at least one frame")
        if command.file.suffix.lower() != ".mp4":
            raise UserError(f"{command.file}: a film is written as MP4: name a .mp4 file")
        super().__init__(method, scene, command.file, tile_count(method, *command.cameras))
        self._command = command
        self._frames = command.file.with_name(f"{command.file.stem}_frames")
        self._part: Part | None = None  # holds the frames until the film is whole
        first = command.cameras[0]
        self._writer = VideoWriter(command.file, command.fps, first.width, first.height)

    def abort(self) -> None:
        """Stop, and delete the video and the frames that are not in their place yet."""
        super().abort()
        self._writer.abort()
        if self._part is not None:
            self._part.release()
            self._part = None
            with suppress(OSError):  # other files lie there
                self._frames.rmdir()

    def _pieces(self) -> Iterator[bool]:
        for number, camera in enumerate(self._command.cameras):
            for color in self._picture(camera):
                if color is None:
                    yield True
                    continue
                frame = to_bytes(color)
                self._writer.add(frame)
                if self._command.frames:
                    write_png(self._frames_part() / f"{number:05d}.png", frame)
        self._writer.close()
        if self._command.frames:
            self._move_frames()

    def _frames_part(self) -> Path:
        """Return the folder for frames of a film that is not whole yet. Raises UserError if it cannot be made."""
        if self._part is None:
            try:
                self._part = Part(self._frames, directory=True)
            except OSError as error:
                raise unwritable(self._frames, error) from error
        return self._part.path

    def _move_frames(self) -> None:
        try:
            for frame in self._frames_part().iterdir():
                frame.replace(self._frames / frame.name)
        except OSError as error:
            raise unwritable(self._frames, error) from error
        if self._part is not None:
            self._part.release()
            self._part = None
