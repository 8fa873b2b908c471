"""What an export job is asked for and how far it is: numpy only, so that messages can carry it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerf_core.geometry.camera import Camera
from nerf_core.rendering.modes import COLOR


@dataclass(frozen=True)
class ExportPath:
    """Render a camera path to an MP4 (and PNG frames beside it) while training goes on."""

    cameras: tuple[Camera, ...]
    fps: float
    file: Path
    frames: bool = False  # also write FILE's stem + "_frames"/00000.png …


@dataclass(frozen=True)
class ExportStill:
    """Render one camera at full resolution to a .png, or a .npy of float32 (H, W, 3) before rounding.

    mode: what the picture shows of each pixel: colour, or a render mode (`nerf_core.rendering.modes`).
    """

    camera: Camera
    file: Path
    mode: str = COLOR


@dataclass(frozen=True)
class ExportModel:
    """Write the model itself; the suffix of the file gives the kind (`nerf_core.rendering.export.models`)."""

    file: Path


ExportRequest = ExportPath | ExportStill | ExportModel


@dataclass(frozen=True)
class Export:
    """An export in progress or just over; done and total count pieces of work, such as the renderer's tiles."""

    file: Path
    done: int
    total: int
    seconds_left: float | None
    state: Literal["running", "done", "cancelled", "failed"] = "running"
