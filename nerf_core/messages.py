"""What the window and the worker say to each other: plain, immutable, picklable; numpy only.

To the worker go an ordered queue of commands and one latest-wins `ViewRequest`. From the worker come one
latest-wins `Snapshot` and an ordered queue of `Notice`s (things that happened once and must not be lost).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from nerf_core.cameras import Camera
from nerf_core.probe import RadianceProbe, RayProbe
from nerf_core.scene import Scene

# ---- to the worker -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ViewRequest:
    """The picture that is wanted now. stamp: grows with every change; answers carry it back."""

    stamp: int
    camera: Camera
    moving: bool


@dataclass(frozen=True)
class OpenScene:
    """Load a capture (None: the demo scene) and build a fresh model for it; then train it, if `train`."""

    path: Path | None
    options: object  # nerf_core.settings.RunSettings; `object` keeps this module free of the trainer
    train: bool = False


@dataclass(frozen=True)
class Train:
    """Train on, until `steps` more steps are done or `seconds` more of training time have passed.

    None: no such limit. Without either, until the schedule ends.
    """

    steps: int | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Pause:
    pass


@dataclass(frozen=True)
class Reset:
    """Forget the weights, start again from the same seed."""


@dataclass(frozen=True)
class UseMethod:
    """Begin anew on the open scene with another method (a name of METHODS, or auto) and its own constants."""

    name: str
    train: bool = False


@dataclass(frozen=True)
class SetShare:
    """How much of the worker's time training keeps while a preview is being drawn, 0.05 … 0.95."""

    train: float


@dataclass(frozen=True)
class SaveCheckpoint:
    path: Path


@dataclass(frozen=True)
class LoadCheckpoint:
    path: Path


@dataclass(frozen=True)
class Inspect:
    """Open the ray through integer `pixel` of `camera`, and keep it open while training goes on.

    point_t: world distance at which the radiance is shown; None: the median depth (else the strongest sample).
    """

    camera: Camera
    pixel: tuple[int, int]
    point_t: float | None = None


@dataclass(frozen=True)
class StopInspecting:
    pass


@dataclass(frozen=True)
class ExportPath:
    """Render a camera path to an MP4 (and PNG frames beside it) while training goes on."""

    cameras: tuple[Camera, ...]
    fps: float
    file: Path
    frames: bool = False  # also write FILE's stem + "_frames"/00000.png …


@dataclass(frozen=True)
class ExportStill:
    """Render one camera at full resolution to a .png, or a .npy of float32 (H, W, 3) before rounding."""

    camera: Camera
    file: Path


@dataclass(frozen=True)
class CancelExport:
    pass


@dataclass(frozen=True)
class Quit:
    pass


Command = (
    OpenScene | Train | Pause | Reset | UseMethod | SetShare | SaveCheckpoint | LoadCheckpoint | Inspect
    | StopInspecting | ExportPath | ExportStill | CancelExport | Quit
)  # fmt: skip

# ---- from the worker -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Notice:
    """Something that happened. path: what the notice leads to (a written file). detail: a traceback."""

    level: Literal["info", "warning", "error"]
    text: str
    path: Path | None = None
    detail: str = ""


@dataclass(frozen=True)
class Preview:
    """A picture of `camera`, computed on a grid that will become every pixel.

    rgba: (h, w, 4) uint8; texel (i, j) was computed at pixel (i·stride, j·stride) of a camera.width ×
    camera.height image, so texel centres lie at (i·stride + 0.5, j·stride + 0.5). Texels of the level in progress
    that are still missing hold an interpolation of the coarser level. alpha is 255.
    depth: (h, w) float32 z-depth, NaN where nothing was hit.
    stride 1 and complete: every pixel has been computed. step: training step of the oldest pixel shown.
    quality: which network drew it, "fine" or "coarse".
    """

    stamp: int
    camera: Camera
    rgba: np.ndarray
    depth: np.ndarray
    stride: int
    complete: bool
    step: int
    quality: str


@dataclass(frozen=True)
class Export:
    """An export in progress or just over; done and total count the renderer's tiles."""

    file: Path
    done: int
    total: int
    seconds_left: float | None
    state: Literal["running", "done", "cancelled", "failed"] = "running"


@dataclass(frozen=True)
class History:
    """Training so far, thinned to at most about 2,000 points: step, loss, PSNR of the training batch in dB."""

    step: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    loss: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    psnr: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))


Status = Literal["empty", "loading", "ready", "training", "paused", "finished", "failed"]


@dataclass(frozen=True)
class Snapshot:
    """Everything the window shows of the worker at one moment.

    loaded: grows with every scene that was opened; reset or loaded models keep it. train_share: the measured share
    of the worker's time that went into training over the last seconds. seconds: training time alone.
    """

    status: Status = "empty"
    loaded: int = 0
    scene: Scene | None = None
    method: str = ""
    method_reason: str = ""  # why this one
    stage: str = ""  # where training stands, if there is something to tell
    coarse: str = ""  # what draws its cheaper pictures; empty: it has none
    device: str = ""
    step: int = 0
    saved_step: int = 0  # of the newest checkpoint that was written or loaded
    total_steps: int = 0
    seconds: float = 0.0
    rays_per_second: float = 0.0
    seconds_left: float | None = None
    train_share: float = 0.0
    wanted_share: float = 0.5
    memory_bytes: int = 0
    history: History = field(default_factory=History)
    preview: Preview | None = None
    ray: RayProbe | None = None
    radiance: RadianceProbe | None = None
    export: Export | None = None
    loading: str = ""  # what is being loaded, with a count, while status is "loading"
    preview_rays_per_second: float = 0.0  # at full quality, while drawing; 0: not measured yet
