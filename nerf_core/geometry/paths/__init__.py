"""Camera paths for videos, one file per kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene

DEFAULT_PATH = "orbit"  # of the command line and the window


@dataclass(frozen=True)
class Option:
    """A number that a kind of path takes. The command line and the window's export panel offer it.

    help: a sentence for the command line, which names the default.
    default: the number if the user gives none, or a function that computes it for a scene.
    least, most: the smallest and the largest number, both allowed.
    unit: what the window writes after the number, such as "°".
    """

    help: str
    default: float | Callable[[Scene], float]
    least: float
    most: float
    unit: str = ""

    def default_in(self, scene: Scene) -> float:
        """Return the default for a scene."""
        return self.default(scene) if callable(self.default) else self.default

    def chosen(self, name: str, value: float | None, scene: Scene) -> float:
        """Return `value`, or the default for `scene` if it is None.

        Raises UserError if the value is beyond the limits or not a number. `name` is the option's own, for the message.
        """
        if value is None:
            return self.default_in(scene)
        if not self.least <= value <= self.most:
            limits = f"{self.least:,.10g} to {self.most:,.10g}"
            raise UserError(f"a camera path's {name} of {value:g}{self.unit}: take a number from {limits}")
        return value


class CameraPath(Protocol):
    """A kind of camera path.

    label: its name in menus.
    summary: a few words for the command line.
    default_frames: the number of frames if the user gives none; None: as many as the scene has views for.
    options: the numbers that only this kind takes, by their keywords in `cameras`.
    """

    label: ClassVar[str]
    summary: ClassVar[str]
    default_frames: ClassVar[int | None]
    options: ClassVar[Mapping[str, Option]]

    @staticmethod
    def cameras(
        scene: Scene, frames: int | None = None, width: int | None = None, height: int | None = None, **options: Any
    ) -> tuple[Camera, ...]:
        """Return one camera per frame, all of one size.

        Args:
            scene: the scene.
            frames: the number of frames; None takes the kind's default.
            width, height: the size of a frame in pixels; None takes the training photos' size.
            options: values for `options`; None takes an option's default.

        Raises:
            UserError: for values without a path.
        """
        ...


PATHS: Registry[type[CameraPath]] = Registry("camera path", "nerf_core.geometry.paths")
