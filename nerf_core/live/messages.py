"""What the window and the worker say to each other: plain, immutable, picklable; numpy only.

To the worker go an ordered queue of commands and one latest-wins `ViewRequest`. From the worker come one
latest-wins `Snapshot` and an ordered queue of `Notice`s (things that happened once and must not be lost).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.probe import Opened, RadianceProbe, RayHistory, RayProbe, Sightings
from nerf_core.probe.directions import Around
from nerf_core.rendering.export.requests import Export, ExportPath, ExportStill
from nerf_core.rendering.modes import COLOR
from nerf_core.training.loss_history import History
from nerf_core.training.settings import RunSettings

# ---- to the worker -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ViewRequest:
    """The picture that is wanted now. stamp: grows with every change; answers carry it back. mode: its colours', or one
    of `nerf_core.rendering.modes`."""

    stamp: int
    camera: Camera
    moving: bool
    mode: str = COLOR


@dataclass(frozen=True)
class OpenScene:
    """Load a capture (None: the demo scene) and build a fresh model for it; then train it, if `train`."""

    path: Path | None
    options: RunSettings
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
    """session: JSON values that come back with the checkpoint, in `Snapshot.session`."""

    path: Path
    session: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class LoadCheckpoint:
    path: Path


@dataclass(frozen=True)
class Inspect:
    """Open the ray through integer `pixel` of `camera`, and keep it open while training goes on.

    point_t: world distance at which the radiance is shown; None: where the verdict has the surface, else the median
    depth, else the strongest sample. around: what the middle of the radiance's disc is.
    """

    camera: Camera
    pixel: tuple[int, int]
    point_t: float | None = None
    around: Around = "viewer"


@dataclass(frozen=True)
class StopInspecting:
    pass


@dataclass(frozen=True)
class Pin:
    """Keep the ray through integer `pixel` of `camera` open as well, and its history from now on, under a number."""

    id: int
    camera: Camera
    pixel: tuple[int, int]


@dataclass(frozen=True)
class Unpin:
    id: int


@dataclass(frozen=True)
class ExportRays:
    """Write the opened ray and pinned ones: those of these numbers, under these names, with their histories. The format
    is that of the suffix (`nerf_core.probe.report`)."""

    file: Path
    pins: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CancelExport:
    pass


@dataclass(frozen=True)
class Quit:
    pass


Command = (
    OpenScene | Train | Pause | Reset | UseMethod | SetShare | SaveCheckpoint | LoadCheckpoint | Inspect
    | StopInspecting | Pin | Unpin | ExportRays | ExportPath | ExportStill | CancelExport | Quit
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
    mode: str = COLOR


@dataclass(frozen=True)
class Pinned:
    """A pinned ray, as it was last opened, and how it came to be; None: not yet."""

    id: int
    ray: RayProbe | None
    history: RayHistory | None


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
    opened: Opened | None = None  # the ray under the lens
    opened_step: int = -1  # of its ray, the rest is as new; −1: some of it is older, or not there yet
    pinned: tuple[Pinned, ...] = ()
    session: Mapping[str, Any] = field(default_factory=dict)  # what the newest loaded checkpoint brought back
    export: Export | None = None
    loading: str = ""  # what is being loaded, with a count, while status is "loading"
    preview_rays_per_second: float = 0.0  # at full quality, while drawing; 0: not measured yet

    @property
    def ray(self) -> RayProbe | None:
        return self.opened.ray if self.opened is not None else None

    @property
    def radiance(self) -> RadianceProbe | None:
        return self.opened.radiance if self.opened is not None else None

    @property
    def evidence(self) -> Sightings | None:
        return self.opened.evidence if self.opened is not None else None
