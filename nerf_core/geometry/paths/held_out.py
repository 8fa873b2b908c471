"""A path through the held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from nerf_core.common.errors import UserError
from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.paths import PATHS, Option
from nerf_core.geometry.paths.steps import checked, video_size
from nerf_core.geometry.scene import Scene


@PATHS.register("test")
class HeldOut:
    """The held-out cameras themselves."""

    label: ClassVar[str] = marked("Held-out views")
    summary: ClassVar[str] = "through the held-out views"
    default_frames: ClassVar[None] = None
    options: ClassVar[Mapping[str, Option]] = {}

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None
    ) -> tuple[Camera, ...]:
        """Return the held-out cameras in their order, each with its own lens; at most `frames` of them, by default all.

        A video has one size. A camera of another aspect ratio keeps its vertical field of view; nothing is stretched.
        Raises UserError if the capture has no held-out views.
        """
        name, indices = scene.held_out()
        if not indices:
            others = " or ".join(path for path in PATHS.names() if PATHS.get(path) is not HeldOut)
            raise UserError(f"scene {scene.name} has no {name} views to render: take the path {others}")
        chosen = indices if frames is None else indices[: checked(frames, "frames")]
        size = video_size(scene, width, height)
        return tuple(_fitted(scene.views[i].camera, *size) for i in chosen)


def _fitted(camera: Camera, width: int, height: int) -> Camera:
    """The camera with width × height pixels. It keeps its vertical field of view and the shape of its pixels."""
    scale = height / camera.height
    cx = width / 2 + (camera.cx - camera.width / 2) * scale
    resized = camera.resized(width, height)
    return replace(resized, fx=camera.fx * scale, cx=cx)
