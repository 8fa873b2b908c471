"""A spiral path in front of the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths import PATHS, Option
from nerf_core.geometry.paths.llff import FRAMES, llff_path
from nerf_core.geometry.scene import Scene


@PATHS.register("spiral")
class Spiral:
    """The official LLFF render path."""

    label: ClassVar[str] = marked("Spiral")
    summary: ClassVar[str] = "a spiral before it"
    default_frames: ClassVar[int] = FRAMES
    options: ClassVar[Mapping[str, Option]] = {}

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None
    ) -> tuple[Camera, ...]:
        """Return two turns around the mean view; see `llff_path`."""
        return llff_path(scene, frames, width, height)
