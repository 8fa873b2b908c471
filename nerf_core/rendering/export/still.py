"""Export one picture at full resolution."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.files import write_atomically
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.rendering.export.jobs import Job, tile_count
from nerf_core.rendering.export.requests import ExportStill
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.modes import COLOR, MODES
from nerf_core.rendering.video import write_png


class StillJob(Job):
    """One picture at full resolution, as .png, or as .npy with float32 (H, W, 3) before rounding."""

    def __init__(self, method: Method, scene: Scene, command: ExportStill) -> None:
        """Check the request.

        Args:
            method: the model; it must not be trained meanwhile.
            scene: its scene.
            command: camera, file and mode.

        Raises:
            UserError: the suffix of the file or the mode is not known.
        """
        if command.file.suffix.lower() not in (".png", ".npy"):
            raise UserError(f"{command.file}: a picture is written as .png or .npy")
        if command.mode != COLOR:
            MODES.get(command.mode)  # raises UserError for an unknown mode, before anything is rendered
        super().__init__(method, scene, command.file, tile_count(method, command.camera))
        self._camera, self._mode = command.camera, command.mode

    def _pieces(self) -> Iterator[bool]:
        for color in self._picture(self._camera, self._mode):
            if color is None:
                yield True
            elif self.progress.file.suffix.lower() == ".npy":
                data = io.BytesIO()
                np.save(data, color)
                write_atomically(self.progress.file, data.getvalue())
            else:
                write_png(self.progress.file, to_bytes(color))
