"""Camera paths for videos, one file per kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from nerf_core.common.registry import Registry
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene


class CameraPath(Protocol):
    """A kind of camera path.

    label: its name in menus.
    summary: a few words for the command line.
    default_frames: the number of frames if the user gives none; None: as many as the scene has views for.
    options: the numbers that only this kind takes: {keyword of `cameras`: a sentence of help}.
    """

    label: ClassVar[str]
    summary: ClassVar[str]
    default_frames: ClassVar[int | None]
    options: ClassVar[Mapping[str, str]]

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None, **options: Any
    ) -> tuple[Camera, ...]:
        """Return one camera per frame, all of one size.

        Args:
            scene: the scene.
            frames: the number of frames; None takes the kind's default.
            width, height: the size of a frame in pixels; None takes the training photos' size.
            options: values for `options`.

        Raises:
            UserError: for values without a path.
        """
        ...


PATHS: Registry[type[CameraPath]] = Registry("camera path", "nerf_core.geometry.paths")
