"""Training: start, pause, step, reset; how far it is and how well it goes; checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.messages import LoadCheckpoint, Pause, Reset, SaveCheckpoint, SetShare, Snapshot, Train
from viewer.history_plots import HistoryPlots
from viewer.panels import PANELS, Ui
from viewer.state import Action, AppState
from viewer.widgets import (
    Confirmation,
    Row,
    button,
    duration,
    field_beside,
    field_width,
    figures,
    hint,
    rate,
    same_line_if_fits,
    unsaved_steps,
)  # fmt: skip

START, PAUSE = f"{icons.ICON_FA_PLAY}  Train", f"{icons.ICON_FA_PAUSE}  Pause"
STEP, RESET = f"{icons.ICON_FA_FORWARD_STEP}  Step", f"{icons.ICON_FA_ROTATE_LEFT}  Reset"
SAVE, LOAD = f"{icons.ICON_FA_FLOPPY_DISK}  Save", f"{icons.ICON_FA_FOLDER_OPEN}  Load"


@PANELS.register("training")
class TrainingPanel:
    title = "Training"
    dock: Literal["right"] = "right"
    order = 1

    def __init__(self) -> None:
        self._plots = HistoryPlots()
        self._reset, self._load = Confirmation(), Confirmation()
        self._share: float | None = None  # what the slider was set to, until the worker has taken it

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot = state.snapshot
        text, color = _progress(ui, snapshot)
        hint(ui, text, color)
        yield from self._buttons(ui, snapshot)
        if snapshot.scene is None:
            return
        self._plots.draw(ui, snapshot)
        figures(ui, "training", _rows(snapshot))
        yield from self._time_share(ui, snapshot)
        yield from self._checkpoint(ui, state)

    def _buttons(self, ui: Ui, snapshot: Snapshot) -> Iterator[Action]:
        can_train = snapshot.status in ("ready", "paused", "failed")
        if snapshot.status == "training":
            if button(ui, PAUSE, "training.pause", tip="pause (Space)"):
                yield Pause()
        elif button(ui, START, "training.start", enabled=can_train, tip="train until the schedule ends (Space)"):
            yield Train()
        same_line_if_fits(STEP)
        if button(ui, STEP, "training.step", enabled=can_train, tip="one step (.)"):
            yield Train(steps=1)
        same_line_if_fits(RESET)
        if button(ui, RESET, "training.reset", enabled=snapshot.step > 0, tip="forget the weights and start again"):
            self._reset.asking = True
        if self._reset.draw(ui, f"This forgets {snapshot.step:,} trained steps.", "Reset", "training.reset"):
            yield Reset()

    def _time_share(self, ui: Ui, snapshot: Snapshot) -> Iterator[Action]:
        if self._share is not None and abs(self._share - snapshot.wanted_share) < 1e-6:
            self._share = None
        percent = 100 * (self._share if self._share is not None else snapshot.wanted_share)
        field_width(ui, "##share")
        now = f" (now {100 * snapshot.train_share:.0f} %%)" if snapshot.status == "training" else ""
        clamp = imgui.SliderFlags_.always_clamp
        changed, percent = imgui.slider_float("##share", percent, 5, 95, f"training gets %.0f %%{now}", clamp)
        ui.mark("training.share")
        imgui.set_item_tooltip("share of the time that training keeps while a preview is being drawn")
        if changed:
            self._share = percent / 100
        if imgui.is_item_deactivated_after_edit() and self._share is not None:
            yield SetShare(self._share)

    def _checkpoint(self, ui: Ui, state: AppState) -> Iterator[Action]:
        field_beside(ui, SAVE, LOAD)
        _, state.checkpoint_file = imgui.input_text_with_hint(
            "##checkpoint", "checkpoint.safetensors", state.checkpoint_file
        )
        ui.mark("training.checkpoint")
        path, unsaved = state.checkpoint_file.strip(), unsaved_steps(state.snapshot)
        same_line_if_fits(SAVE)
        if button(ui, SAVE, "training.save", enabled=bool(path), tip="all that training needs to go on (Ctrl+S)"):
            yield SaveCheckpoint(Path(path).expanduser())
        same_line_if_fits(LOAD)
        pressed = button(ui, LOAD, "training.load", enabled=bool(path), tip="go on from this checkpoint")
        self._load.asking = self._load.asking or (pressed and unsaved > 0)
        question = f"Loading forgets {unsaved:,} unsaved training steps."
        if self._load.draw(ui, question, "Load", "training.load") or (pressed and unsaved == 0):
            yield LoadCheckpoint(Path(path).expanduser())


def _progress(ui: Ui, s: Snapshot) -> tuple[str, ImVec4]:
    steps = f"{s.step:,} of {s.total_steps:,} steps"
    left = f", {duration(s.seconds_left)} left" if s.seconds_left is not None else ""
    return {
        "empty": ("Nothing to train yet: open a scene.", ui.theme.muted),
        "loading": ("Training can start once the scene is loaded.", ui.theme.muted),
        "ready": (f"Ready: {steps}", ui.theme.text),
        "training": (f"Training: {steps}{left}", ui.theme.text),
        "paused": (f"Paused: {steps}", ui.theme.text),
        "finished": (f"Finished: {s.step:,} steps in {duration(s.seconds)}", ui.theme.good),
        "failed": (f"Stopped by an error after {steps}: see Notices.", ui.theme.error),
    }[s.status]


def _rows(s: Snapshot) -> list[Row]:
    return [("speed", f"{rate(s.rays_per_second)} rays/s"), ("trained", duration(s.seconds))]
