"""What the window and the worker say to each other: plain, immutable, picklable; numpy only.

To the worker go an ordered queue of commands and one latest-wins `ViewRequest`. From the worker come one
latest-wins `Snapshot` and an ordered queue of `Notice`s (things that happened once and must not be lost).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from nerf_core.captures.records import PoseProgress
from nerf_core.captures.report_records import ReportState
from nerf_core.common.names import printable
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.lab.records import StudyState
from nerf_core.probe import Opened, RadianceProbe, RayHistory, RayProbe, Sightings
from nerf_core.probe.axis import AxisChoice
from nerf_core.probe.directions import Around
from nerf_core.rendering.export.requests import Export, ExportRequest
from nerf_core.rendering.modes import COLOR
from nerf_core.training.loss_history import History
from nerf_core.training.pose_records import PoseCorrections
from nerf_core.training.settings import RunSettings

FIRST_RUN = 1  # the run that exists from the beginning: a window that shows one model never names another
MOST_PINS = 8  # as many as there are colours that can be told apart
PIN_NAME_LENGTH = 60

_fresh = itertools.count(1).__next__  # ids are unique within a process

# ---- to the worker -------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OfRun:
    """A message about one run: a scene with one model.

    run: its number.
    quick: whether the worker obeys it in the middle of a training step. Such a command touches neither the weights nor
        whose they are. Any other command abandons the step.
    """

    quick: ClassVar[bool] = False
    run: int = FIRST_RUN


@dataclass(frozen=True)
class ViewRequest(OfRun):
    """The picture that is wanted now.

    stamp: grows with every change; answers carry it back.
    mode: what is drawn of each pixel, one of `nerf_core.rendering.modes.mode_names()`.
    """

    stamp: int
    camera: Camera
    moving: bool
    mode: str = COLOR


@dataclass(frozen=True)
class OpenScene(OfRun):
    """Load a capture and build a model for it; then train it, if `train`.

    path: None: the demo scene.
    checkpoint: the file that holds the model; None: a fresh one. If either cannot be loaded, neither is.
    """

    path: Path | None
    options: RunSettings
    train: bool = False
    checkpoint: Path | None = None


@dataclass(frozen=True)
class CancelLoading(OfRun):
    """Abandon the loading that commands before this one began; the scene and the model that are open stay."""

    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class OpenRun(OfRun):
    """Add run number `run`: a fresh model of `method` on the scene of run `like`; then train it, if `train`."""

    method: str
    like: int = FIRST_RUN
    train: bool = False


@dataclass(frozen=True)
class CloseRun(OfRun):
    """Forget a run. The first one stays."""


@dataclass(frozen=True)
class Train(OfRun):
    """Train on, until `steps` more steps are done or `seconds` more of training time have passed.

    None: no such limit. Without either, until the schedule ends.
    """

    steps: int | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Pause(OfRun):
    pass


@dataclass(frozen=True)
class Reset(OfRun):
    """Forget the weights, start again from the same seed."""


@dataclass(frozen=True)
class UseMethod(OfRun):
    """Begin anew on the open scene with another method (a name of METHODS, or auto) and its own constants.

    changes: of its constants, as text by name; others are as the method has them.
    """

    name: str
    train: bool = False
    changes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SetShare:
    """How much of the worker's time training keeps while pictures are drawn.

    train: 0.05 … 0.95. rule: one of `nerf_core.live.shares.SHARES`, which may vary it with the situation.
    """

    quick: ClassVar[bool] = True
    train: float
    rule: str = "steady"


@dataclass(frozen=True)
class SaveCheckpoint(OfRun):
    """Write the model and its pinned rays to a file. An old one of this name is replaced."""

    path: Path


@dataclass(frozen=True)
class SaveUnsaved(OfRun):
    """Write the model and its pinned rays if it has steps that no checkpoint has, to the first place that takes it.

    The places: `file`, which is replaced; `folder`, where the file is named after the scene and replaces none; then
    those of `spare_files`. None: not there.
    """

    file: Path | None = None
    folder: Path | None = None


@dataclass(frozen=True)
class InOrder(OfRun):
    """Obey these commands one after the other; where one fails, the rest is not done."""

    commands: tuple[OfRun, ...]


@dataclass(frozen=True)
class LoadCheckpoint(OfRun):
    path: Path


@dataclass(frozen=True)
class Inspect(OfRun):
    """Open the ray through integer `pixel` of `camera`, and keep it open while training goes on.

    point_t: world distance at which the radiance is shown; None: where the verdict has the surface, else the median
    depth, else the strongest sample. around: what the middle of the radiance's disc is.
    id: of the ray; a pin of the same ray has the same. look: of this request; answers carry it back.
    """

    quick: ClassVar[bool] = True
    camera: Camera
    pixel: tuple[int, int]
    point_t: float | None = None
    around: Around = "viewer"
    id: int = field(default_factory=_fresh)
    look: int = field(default_factory=_fresh)

    def again(self, **changes: Any) -> Inspect:
        """Another look at the same ray, with another `point_t` or `around`."""
        return replace(self, look=_fresh(), **changes)


@dataclass(frozen=True)
class StopInspecting(OfRun):
    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class PinRay(OfRun):
    """Keep the ray through integer `pixel` of `camera` open as well, and its history from now on.

    name: empty for "ray N". hidden: not drawn in the viewport. id: see `Inspect`.
    """

    quick: ClassVar[bool] = True
    camera: Camera
    pixel: tuple[int, int]
    name: str = ""
    hidden: bool = False
    id: int = field(default_factory=_fresh)

    @staticmethod
    def of(ray: Inspect) -> PinRay:
        return PinRay(ray.camera, ray.pixel, id=ray.id, run=ray.run)


@dataclass(frozen=True)
class EditPin(OfRun):
    """Rename, hide or show a pinned ray; None: as it is."""

    quick: ClassVar[bool] = True
    id: int
    name: str | None = None
    hidden: bool | None = None


@dataclass(frozen=True)
class UnpinRay(OfRun):
    quick: ClassVar[bool] = True
    id: int


@dataclass(frozen=True)
class ExportRays(OfRun):
    """Write the opened ray and the pinned ones that are not hidden, with their histories.

    The suffix of the file gives the format (`nerf_core.probe.report`).

    axis: see `write_inspection`.
    """

    file: Path
    axis: AxisChoice = "auto"


@dataclass(frozen=True)
class StartExport(OfRun):
    """Write a film, a picture or the model itself as it is now, while training goes on."""

    quick: ClassVar[bool] = True
    request: ExportRequest


@dataclass(frozen=True)
class CancelExport(OfRun):
    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class StartStudy(OfRun):
    """Begin a study of the open scene, or of a photo, while everything else goes on. There is one at a time.

    name: one of `nerf_core.lab.study.STUDIES`.
    options: its constants that differ from the defaults, as text by name.
    folder: where its files go; a study that was interrupted goes on there.
    photo: the photo, for a study of one; None: what the program comes with.
    """

    name: str
    options: dict[str, str]
    folder: Path
    photo: Path | None = None


@dataclass(frozen=True)
class CancelStudy(OfRun):
    """Stop the study; what is done stays in its folder."""

    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class TurnKnob(OfRun):
    """Turn a knob of the study that runs."""

    quick: ClassVar[bool] = True
    knob: str
    value: float


@dataclass(frozen=True)
class StartReport(OfRun):
    """Check the photos of the open scene while everything else goes on, in place of a check that runs."""

    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class CancelReport(OfRun):
    quick: ClassVar[bool] = True


@dataclass(frozen=True)
class WriteReport(OfRun):
    """Write the newest capture report as an HTML page, and its numbers beside it."""

    quick: ClassVar[bool] = True
    file: Path


@dataclass(frozen=True)
class Quit:
    quick: ClassVar[bool] = False


Command = (
    OpenScene | CancelLoading | OpenRun | CloseRun | Train | Pause | Reset | UseMethod | SetShare | SaveCheckpoint
    | SaveUnsaved | InOrder | LoadCheckpoint | Inspect | StopInspecting | PinRay | EditPin | UnpinRay | ExportRays
    | StartExport | CancelExport | StartStudy | CancelStudy | TurnKnob | StartReport | CancelReport | WriteReport | Quit
)  # fmt: skip

# ---- from the worker -----------------------------------------------------------------------------------------


Level = Literal["info", "warning", "error"]
Kind = Literal["note", "loaded", "saved", "wrote", "exported", "studied", "failed"]


@dataclass(frozen=True)
class Notice:
    """Something that happened.

    text: a line for people; it may be reworded. It may be given with names of files as they are; see `printable`.
    path: the file that was written or read.
    detail: a traceback, likewise.
    kind: what happened, for programs.
    command: the number that `Worker.send` gave to the command that this answers; 0: it answers none.
    run: the run's number.
    """

    level: Level
    text: str
    path: Path | None = None
    detail: str = ""
    kind: Kind = "note"
    command: int = 0
    run: int = FIRST_RUN

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", printable(self.text))
        object.__setattr__(self, "detail", "\n".join(map(printable, self.detail.split("\n"))))


@dataclass(frozen=True)
class Preview:
    """A picture of `camera`, computed on a grid that will become every pixel.

    stamp: of the `ViewRequest`.
    rgba: (h, w, 4) uint8; texel (i, j) was computed at pixel (i·stride, j·stride) of a camera.width ×
        camera.height image, so texel centres lie at (i·stride + 0.5, j·stride + 0.5). Texels of the level in progress
        that are still missing hold an interpolation of the coarser level. alpha is 255.
    depth: (h, w) float32 z-depth, NaN where nothing was hit.
    stride: pixels between two texels.
    complete: whether every texel of this stride was computed. With stride 1, every pixel was.
    step: the training step of the oldest pixel shown.
    quality: which network drew it, "fine" or "coarse".
    model: a number of the model that drew it; a reset or loaded one has another, and so has a network that takes over.
    born: the training step at which that model began to learn.
    caption: what the picture shows, in the method's words; empty: nothing worth saying.
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
    model: int = 0
    born: int = 0
    caption: str = ""


@dataclass(frozen=True)
class Pin:
    """A pinned ray with its place in the lists: the worker owns it, windows show it.

    color: index into the palette of rays; no other pin of the run has it.
    ray: as it was last opened; None: not yet.
    history: its weights since it was pinned; None: no record yet.
    """

    id: int
    name: str
    color: int
    hidden: bool
    camera: Camera
    pixel: tuple[int, int]
    ray: RayProbe | None = None
    history: RayHistory | None = None

    def inspect(self, run: int = FIRST_RUN) -> Inspect:
        """Return the request that opens this ray."""
        return Inspect(self.camera, self.pixel, id=self.id, run=run)


Status = Literal["empty", "loading", "ready", "training", "paused", "finished", "failed"]


@dataclass(frozen=True)
class Snapshot:
    """Everything the window shows of one run at one moment.

    scene: with the poses as they are corrected now.
    loaded: grows with every scene that was opened; reset or loaded models keep it.
    method_reason: why this method was chosen.
    config: the method's constants by name, as a checkpoint stores them.
    stage: a remark about the progress of training; empty: none.
    coarse: the name of the method's cheaper picture; empty: it has none.
    saved_step: of the newest checkpoint that was written or loaded; 0 if that file has gone since.
    seconds: training time alone.
    train_share: the measured share of the worker's time that went into training over the last seconds.
    wanted_share: the share that was asked for.
    frame_share: of the time, for frames, previews or exports each, while training goes on.
    opened: the ray under the lens.
    opened_id: its id; 0: none is open.
    opened_look: the `Inspect.look` that is answered whole; 0: not yet.
    opened_step: the training step of the whole opened ray; −1: some of it is of another step, or not there yet.
    loading: what is being loaded, with a count, while `status` is "loading".
    posing: how far poses are found, while they are; None: they are not.
    preview_rays_per_second: at full quality, while drawing; 0: not measured yet.
    study: the newest study of the worker, whatever run it is about; None: there was none.
    report: the newest check of a capture's photos, likewise.
    corrections: by how much cameras of training photos were moved; None: poses are not corrected.
    """

    run: int = FIRST_RUN
    status: Status = "empty"
    loaded: int = 0
    posing: PoseProgress | None = None
    scene: Scene | None = None
    method: str = ""
    method_reason: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    stage: str = ""
    coarse: str = ""
    device: str = ""
    step: int = 0
    saved_step: int = 0
    total_steps: int = 0
    seconds: float = 0.0
    rays_per_second: float = 0.0
    seconds_left: float | None = None
    train_share: float = 0.0
    wanted_share: float = 0.5
    share_rule: str = "steady"
    frame_share: float = 0.25
    memory_bytes: int = 0
    history: History = field(default_factory=History)
    preview: Preview | None = None
    opened: Opened | None = None
    opened_id: int = 0
    opened_look: int = 0
    opened_step: int = -1
    pins: tuple[Pin, ...] = ()
    export: Export | None = None
    loading: str = ""
    preview_rays_per_second: float = 0.0
    study: StudyState | None = None
    report: ReportState | None = None
    corrections: PoseCorrections | None = None

    @property
    def ray(self) -> RayProbe | None:
        return self.opened.ray if self.opened is not None else None

    @property
    def radiance(self) -> RadianceProbe | None:
        return self.opened.radiance if self.opened is not None else None

    @property
    def evidence(self) -> Sightings | None:
        return self.opened.evidence if self.opened is not None else None
