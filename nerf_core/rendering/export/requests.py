"""Requests for exports, and their progress. They need numpy only, so that messages can carry them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerf_core.geometry.camera import Camera
from nerf_core.rendering.modes import COLOR


@dataclass(frozen=True)
class ExportPath:
    """Render a camera path to an MP4.

    cameras: one for each frame.
    fps: frames per second.
    file: the .mp4 file.
    frames: whether to write PNG frames, too: 00000.png, … in a folder beside the file, named after it with "_frames".
    """

    cameras: tuple[Camera, ...]
    fps: float
    file: Path
    frames: bool = False


@dataclass(frozen=True)
class ExportStill:
    """Render one picture at full resolution.

    camera: the camera; its width and height are those of the picture.
    file: a .png, or a .npy with float32 (H, W, 3) in [0, 1] before rounding.
    mode: what the picture shows of each pixel: colour, or a render mode (`nerf_core.rendering.modes`).
    """

    camera: Camera
    file: Path
    mode: str = COLOR


@dataclass(frozen=True)
class ExportModel:
    """Write the model itself.

    file: its suffix chooses the kind of export (`nerf_core.rendering.export.models`).
    """

    file: Path


ExportRequest = ExportPath | ExportStill | ExportModel


@dataclass(frozen=True)
class Export:
    """The progress of an export.

    file: the file that is written.
    done, total: pieces of work, such as tiles of pictures.
    seconds_left: an estimate; None before the first piece.
    state: "running", or how it ended.
    """

    file: Path
    done: int
    total: int
    seconds_left: float | None
    state: Literal["running", "done", "cancelled", "failed"] = "running"
