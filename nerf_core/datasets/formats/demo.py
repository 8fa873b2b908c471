"""The demo scene, which is installed with the program in Blender's format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions

LANDMARKS = (("glossy ball", 0.43, 0.59), ("vase", 0.61, 0.60), ("past the ball", 0.30, 0.20))


@DATASETS.register("demo")
class Demo:
    """The demo is opened by name, or if no dataset is named. No folder is recognised as it."""

    rank: ClassVar[int] = -1
    files: ClassVar[str] = "installed with the program"

    @staticmethod
    def matches(path: Path) -> bool:
        return False

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        return replace(DATASETS.get("blender").read(path, options), format="demo", landmarks=LANDMARKS)
