"""The window's state: the worker's newest snapshot, the user's camera, forms and choices."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from nerf_core.captures.records import PoseProgress
from nerf_core.common.language import ENGLISH
from nerf_core.geometry.paths import DEFAULT_PATH
from nerf_core.live.messages import Command, Inspect, Notice, Snapshot
from nerf_core.methods import nothing_to_train
from nerf_core.probe.axis import AxisChoice
from nerf_core.probe.directions import Around, Source
from nerf_core.rendering.modes import COLOR
from nerf_core.training.settings import RunSettings

from .camera_control import CameraControl
from .left_off import LeftOff

# ---- what a panel may ask of the app, besides the worker's commands -------------------------------------------


@dataclass(frozen=True)
class GoToView:
    """Fly to the photo with this index in the scene."""

    index: int


@dataclass(frozen=True)
class FocusOn:
    """Orbit around this world point."""

    point: np.ndarray


@dataclass(frozen=True)
class ResetView:
    pass


@dataclass(frozen=True)
class FrameScene:
    pass


@dataclass(frozen=True)
class SetPointDepth:
    """Show the radiance at this world distance along the inspected ray; None: at the surface."""

    t: float | None


@dataclass(frozen=True)
class SetDisc:
    """Centre the radiance's disc on the viewer or on the density's normal."""

    around: Around


@dataclass(frozen=True)
class SaveScreenshot:
    path: Path


@dataclass(frozen=True)
class StartFilmExport:
    """Export the film that `AppState.film` describes. file: where to; None: where the form says."""

    file: Path | None = None


@dataclass(frozen=True)
class ClearAutosaves:
    """Delete the autosaves that `AppState.left_off` lists."""


Action = (
    Command | GoToView | FocusOn | ResetView | FrameScene | SetPointDepth | SetDisc | SaveScreenshot
    | StartFilmExport | ClearAutosaves
)  # fmt: skip


@dataclass(frozen=True)
class TourWish:
    """What the user asks of the tour.

    to: "begin", "next", "back" or "leave". folder: of the steps of the tour to begin; None: the program's own.
    """

    to: Literal["begin", "next", "back", "leave"]
    folder: Path | None = None


@dataclass
class FilmForm:
    """The fields of the export panel.

    path: a kind of `nerf_core.geometry.paths.PATHS`.
    frames: 0: as many as the path has.
    options: the path's own that the user chose, by name; the path has a default for each of the others.
    width, height: the size in pixels; 0: the training photos' size.
    """

    path: str = DEFAULT_PATH
    frames: int = 0
    fps: float = 30.0
    options: dict[str, float] = field(default_factory=dict)
    width: int = 0
    height: int = 0
    png_frames: bool = False
    file: str = "film.mp4"


TOAST_SECONDS = 10.0  # time for which a result is shown over the picture; an error is for three times as long
READ_PER_SECOND = 8  # letters, about half of what people read, because they look at the picture first


@dataclass
class ShownNotice:
    notice: Notice
    born: float  # seconds on the app's clock
    dismissed: bool = False

    @property
    def ends(self) -> float:
        """When it is no longer shown over the picture, on the app's clock. The notices panel keeps it."""
        reading = len(self.notice.text) / READ_PER_SECOND
        if self.notice.level == "error":
            return self.born + 3 * TOAST_SECONDS + reading
        return self.born + (TOAST_SECONDS + reading if self.notice.path is not None else 0.0)


class SampleRef(NamedTuple):
    """A sample of the opened ray: the number of its pass, and its index there."""

    one: int
    at: int


@dataclass
class AppState:
    """The state of the window. The GUI thread owns it. Panels read it, and write only the fields marked *."""

    snapshot: Snapshot = field(default_factory=Snapshot)
    camera: CameraControl = field(default_factory=CameraControl)
    inspect: Inspect | None = None  # the ray that was asked for last; the answer is snapshot.ray
    sample: SampleRef | None = None  # the sample that the user pointed at in the last frame, in any panel
    pointed_at: SampleRef | None = None  # * the same in this frame
    focus: Inspect | None = None  # the ray of a double click whose verdict has not come yet
    viewport: tuple[int, int] = (640, 480)  # framebuffer pixels
    viewport_rect: tuple[float, float, float, float] | None = None  # x, y, width, height in imgui's coordinates
    frames_per_second: float = 0.0
    notices: list[ShownNotice] = field(default_factory=list)
    film: FilmForm = field(default_factory=FilmForm)  # *
    checkpoint_file: str = ""  # *
    rays_file: str = "rays.json"  # *
    model_file: str = ""  # *
    open_path: str = ""  # *
    not_opened: str = ""  # why what should have been opened is not, if nothing is open
    searched: PoseProgress | None = None  # the last search for poses, if it ended without all that it looks for
    left_off: LeftOff = field(default_factory=LeftOff)
    show_left_off: bool = False  # * offer the autosaves
    settings: RunSettings = field(default_factory=RunSettings)  # * settings for the next capture
    focus_open: bool = False  # * give the scene panel's path field the keyboard in the next frame
    raise_panel: str = ""  # * title of the panel whose tab comes to the front in the next frame
    in_front: tuple[str, ...] = ()  # titles of the panels that were not behind another's tab in the last frame
    only_panels: tuple[str, ...] | None = None  # titles of the panels that are shown; None: all
    page: str = ""  # title of the panel that is shown alone, in the place of the picture and all panels; empty: none
    presenter: bool = False  # * large type and strong contrast, for a lecture hall
    tour: TourWish | None = None  # * what the user asks of the tour
    in_tour: bool = False
    show_cameras: bool = False  # * training cameras in the viewport
    show_samples: bool = True  # * the inspected ray and its samples in the viewport
    mode: str = COLOR  # * the viewport's render mode; see nerf_core.rendering.modes
    language: str = ENGLISH  # * the code of the language that the window shows
    axis: AxisChoice = "auto"  # * of the ray's plots
    radiance_of: Source | None = None  # * whose radiance is shown; None: the probe's default
    hand_changes: int = 0  # * how often the user has changed the ray by hand
    show_help: bool = False  # *
    show_palette: bool = False  # *
    show_panels: bool = True  # *
    reset_layout: bool = False  # * show the default layout from the next frame on
    quit: bool = False  # * close the window after this frame
    current_view: int | None = None  # the photo at whose camera the user looks, until the camera moves
    time: float = 0.0  # seconds on the app's clock
    has_display: bool = True

    @property
    def unposed(self) -> PoseProgress | None:
        """The search for poses for want of which nothing is open; None: that is not the reason."""
        return self.searched if self.not_opened else None


def nothing_to_train_in(snapshot: Snapshot) -> str:
    """Return a sentence if the run has a model that cannot be trained; empty if it has another or none."""
    return nothing_to_train(snapshot.method) if snapshot.method and not snapshot.total_steps else ""


def unsaved_steps(snapshot: Snapshot) -> int:
    """Return how many training steps would be lost: those since the newest checkpoint."""
    return max(snapshot.step - snapshot.saved_step, 0)
