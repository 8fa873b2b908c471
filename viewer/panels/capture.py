"""The capture panel: how poses are found of photos that have none, and which photos could not be placed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal, TypeVar

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.captures.records import COPYING, PLACED, STAGES, PoseProgress
from nerf_core.common.language import figure, marked, phrases, tr
from nerf_core.common.text import duration
from nerf_core.datasets.capture import PoseLens, Quality
from nerf_core.live.messages import CancelLoading

from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, field_width, hint

T = TypeVar("T")
QUALITIES: dict[Quality, tuple[str, str]] = {  # named as on the command line, and what each is for
    "fast": (marked("fast"), marked("a third of the time; enough for most photos")),
    "normal": (marked("normal"), marked("photos of up to 1,600 pixels, 4,096 features each")),
    "high": (marked("high"), marked("photos of up to 3,200 pixels, 8,192 features each: for little texture")),
}
LENSES: dict[PoseLens, tuple[str, str]] = {
    "perspective": (marked("perspective"), marked("phones and most cameras: straight things look straight")),
    "fisheye": (marked("fisheye"), marked("action cameras and very wide lenses, which bend straight things")),
}
CANCEL = marked("Cancel")


@PANELS.register("capture")
class CapturePanel:
    title = marked("Capture")
    dock: Literal["right"] = "right"
    order = 6

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        posing = state.snapshot.posing
        if posing is None:
            _idle(ui, state)
            return
        _stages(ui, posing)
        imgui.progress_bar(posing.done / max(posing.total, 1), ImVec2(-1, 0), "")
        ui.mark("capture.progress")
        if posing.seconds_left is not None:
            left = tr("{time} left for this").format(time=tr(duration(posing.seconds_left)))
            hint(ui, left)
        if posing.growing is not None:
            placed = phrases(
                "{n:,} of {total:,} photos has a pose",
                "{n:,} of {total:,} photos have a pose",
                posing.placed,
                total=posing.photos,
            )
            hint(ui, tr(placed), ui.theme.accent)
        cancel = f"{icons.ICON_FA_XMARK}  {tr(CANCEL)}"
        if button(ui, cancel, "capture.cancel", tip=tr("stop; nothing half done is kept")):
            yield CancelLoading()


def _stages(ui: Ui, posing: PoseProgress) -> None:
    """The stages in their order: those that are done, the one that is going on with its count, those to come."""
    order = [COPYING, *STAGES.values()]
    now = len(order) if posing.stage == PLACED else order.index(posing.stage) if posing.stage in order else -1
    if now < 0:
        hint(ui, tr(posing.stage), ui.theme.accent)
    for k, stage in enumerate(order):
        sign = icons.ICON_FA_CHECK if k < now else icons.ICON_FA_ARROW_RIGHT if k == now else icons.ICON_FA_MINUS
        color = ui.theme.good if k < now else ui.theme.accent if k == now else ui.theme.muted
        imgui.text_colored(color, sign)
        imgui.same_line(2 * ui.em)
        text = tr(stage)
        if k == now:
            text = tr("{stage}: {done} of {total}").format(
                stage=text, done=figure(posing.done, ","), total=figure(posing.total, ",")
            )
        imgui.text_wrapped(text)


def _idle(ui: Ui, state: AppState) -> None:
    """How well poses were found, what can be opened, and how carefully its poses are found."""
    scene = state.snapshot.scene
    if scene is not None and scene.posed:
        imgui.text_colored(ui.theme.good, icons.ICON_FA_CHECK)
        imgui.same_line(2 * ui.em)
        imgui.text_wrapped(tr(scene.posed))
        imgui.spacing()
    text = tr(
        "Open a folder of photos or a video in the Scene panel. If it has no poses, they are found "
        "first: the cameras find their places in the viewport, then training begins."
    )
    hint(ui, text)
    load = state.settings.load
    poses = _choice(ui, "quality", marked("quality of poses"), QUALITIES, load.poses)
    lens = _choice(ui, "lens", marked("lens"), LENSES, load.lens)
    if (poses, lens) != (load.poses, load.lens):
        state.settings = replace(state.settings, load=replace(load, poses=poses, lens=lens))


def _choice(ui: Ui, mark: str, label: str, choices: Mapping[T, tuple[str, str]], now: T) -> T:
    """Draw a box with choices and what the chosen one means. Returns the one that is chosen then."""
    label, (name, meaning) = tr(label), choices[now]
    chosen = now
    field_width(ui, label)
    if imgui.begin_combo(f"{label}###{mark}", tr(name)):
        for choice, (other, words) in choices.items():
            if imgui.selectable(f"{tr(other)}##{choice}", choice == now)[0]:
                chosen = choice
            ui.mark(f"capture.{mark}.{choice}")
            imgui.set_item_tooltip(tr(words))
        imgui.end_combo()
    ui.mark(f"capture.{mark}")
    hint(ui, tr(meaning))
    return chosen
