"""The training panel: start, pause, step, reset; progress and quality; checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.text import counted, duration, rate
from nerf_core.live.messages import LoadCheckpoint, Pause, Reset, SetShare, Snapshot, Train
from nerf_core.live.shares import SHARES

from ..commands.actions.files import saved_first
from ..commands.registry import run, with_keys
from ..draw.history_plots import HistoryPlots
from ..model.state import Action, AppState, nothing_to_train_in, unsaved_steps
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Forgetting, Row, button, exists, field_beside, field_width, figures, hint, same_line_if_fits

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
        self._reset, self._load = Forgetting(), Forgetting()
        self._share: float | None = None  # the slider's value until the worker has taken it

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot = state.snapshot
        text, color = _progress(ui, snapshot)
        hint(ui, text, color)
        yield from self._buttons(ui, state)
        if snapshot.scene is None:
            return
        if snapshot.total_steps:
            self._plots.draw(ui, snapshot)
            figures(ui, "training", _rows(snapshot))
            yield from self._time_share(ui, snapshot)
        yield from self._checkpoint(ui, state)

    def _buttons(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot = state.snapshot
        untrainable = nothing_to_train_in(snapshot)
        can_train = snapshot.status in ("ready", "paused", "failed") and not untrainable
        training = snapshot.status == "training"
        tip = untrainable or with_keys("pause" if training else "train until the schedule ends", "training.toggle")
        if training:
            if button(ui, PAUSE, "training.pause", tip=tip):
                yield Pause()
        elif button(ui, START, "training.start", enabled=can_train, tip=tip):
            yield Train()
        same_line_if_fits(STEP)
        if button(
            ui, STEP, "training.step", enabled=can_train, tip=untrainable or with_keys("one step", "training.step")
        ):
            yield Train(steps=1)
        same_line_if_fits(RESET)
        tip = "" if self._reset.asking else "forget the weights and start again"  # a tooltip would cover the question
        if button(ui, RESET, "training.reset", enabled=snapshot.step > 0, tip=tip):
            self._reset.asking = True
        question = f"This forgets {counted(snapshot.step, 'trained step')}."
        answer = self._reset.ask(ui, question, "start again", "training.reset", needed=snapshot.step > 0)
        if answer:
            yield Reset() if answer == "forget" else saved_first(state, Reset())

    def _time_share(self, ui: Ui, snapshot: Snapshot) -> Iterator[Action]:
        if self._share is not None and abs(self._share - snapshot.wanted_share) < 1e-6:
            self._share = None
        percent = 100 * (self._share if self._share is not None else snapshot.wanted_share)
        label = f"training gets {percent:.0f} %"
        field_width(ui, "training gets 95 %")
        clamp = imgui.SliderFlags_.always_clamp
        changed, percent = imgui.slider_float(f"{label}###share", percent, 5, 95, "", clamp)
        ui.mark("training.share")
        now = f"; now it has {100 * snapshot.train_share:.0f} %" if snapshot.status == "training" else ""
        imgui.set_item_tooltip(
            f"of the time while there are pictures to draw{now}; the pictures and the window's frames share the rest"
        )
        if changed:
            self._share = percent / 100
        if imgui.is_item_deactivated_after_edit() and self._share is not None:
            yield SetShare(self._share, snapshot.share_rule)
        names = list(SHARES.names())
        if len(names) > 1:
            field_width(ui, "rule")
            at = names.index(snapshot.share_rule)
            changed, at = imgui.combo("rule##share", at, [SHARES.get(name).label for name in names])
            ui.mark("training.rule")
            imgui.set_item_tooltip(SHARES.get(names[at]).tip)
            if changed:
                yield SetShare(snapshot.wanted_share, names[at])

    def _checkpoint(self, ui: Ui, state: AppState) -> Iterator[Action]:
        field_beside(ui, SAVE, LOAD)
        _, state.checkpoint_file = imgui.input_text_with_hint(
            "##checkpoint", "a checkpoint's file", state.checkpoint_file
        )
        ui.mark("training.checkpoint")
        path, unsaved = state.checkpoint_file.strip(), unsaved_steps(state.snapshot)
        same_line_if_fits(SAVE)
        if button(ui, SAVE, "training.save", tip=with_keys("all that training needs to go on", "file.save")):
            yield from run("file.save", state)
        same_line_if_fits(LOAD)
        tip = "" if self._load.asking else "go on from this checkpoint"
        pressed = button(ui, LOAD, "training.load", enabled=bool(path), tip=tip)
        if pressed and not exists(Path(path)):
            unsaved = 0  # nothing is forgotten, and the worker says what is wrong
        self._load.asking = self._load.asking or pressed
        question = f"Loading forgets {counted(unsaved, 'unsaved training step')}."
        answer = self._load.ask(ui, question, "load", "training.load", needed=unsaved > 0)
        if answer or (pressed and unsaved == 0):
            loading = LoadCheckpoint(Path(path))
            yield saved_first(state, loading) if answer == "save" else loading


def _progress(ui: Ui, s: Snapshot) -> tuple[str, ImVec4]:
    steps = f"{s.step:,} of {s.total_steps:,} steps"
    left = f", {duration(s.seconds_left)} left" if s.seconds_left is not None else ""
    if s.status == "finished" and (untrainable := nothing_to_train_in(s)):
        return f"{untrainable[0].upper()}{untrainable[1:]}.", ui.theme.muted
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
