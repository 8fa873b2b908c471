"""Camera paths to render as a video: one file a kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from nerf_core.common.registry import Registry
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene


class CameraPath(Protocol):
    """A kind of camera path.

    label: for menus. summary: a few words for the command line. default_frames: their number if none is asked for;
    None: as many as the scene has. options: what only this kind can be asked for, by keyword of `cameras`, with a
    sentence of help; each is a number.
    """

    label: ClassVar[str]
    summary: ClassVar[str]
    default_frames: ClassVar[int | None]
    options: ClassVar[Mapping[str, str]]

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None, **options: Any
    ) -> tuple[Camera, ...]:
        """One camera for each frame, all of one size; None: the path's or the training photos' own.

        Raises UserError for values that give no path.
        """
        ...


PATHS: Registry[type[CameraPath]] = Registry("camera path", "nerf_core.geometry.paths")
