"""The training panel: start, pause, step, reset; progress and quality; checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from imgui_bundle import ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, phrase, phrases, tr, trn
from nerf_core.common.text import duration, rate
from nerf_core.live.messages import LoadCheckpoint, Pause, Reset, SetShare, Snapshot, Train
from nerf_core.live.shares import SHARES

from ..commands.actions.files import saved_first
from ..commands.registry import run, with_keys
from ..draw.history_plots import HistoryPlots
from ..model.state import Action, AppState, nothing_to_train_in, unsaved_steps
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Forgetting, Row, button, exists, field_beside, field_width, figures, hint, same_line_if_fits

START, PAUSE = (icons.ICON_FA_PLAY, marked("Train")), (icons.ICON_FA_PAUSE, marked("Pause"))
STEP, RESET = (icons.ICON_FA_FORWARD_STEP, marked("Step")), (icons.ICON_FA_ROTATE_LEFT, marked("Reset"))
SAVE, LOAD = (icons.ICON_FA_FLOPPY_DISK, marked("Save")), (icons.ICON_FA_FOLDER_OPEN, marked("Load"))


@PANELS.register("training")
class TrainingPanel:
    title = marked("Training")
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
        untrainable = tr(nothing_to_train_in(snapshot))
        can_train = snapshot.status in ("ready", "paused", "failed") and not untrainable
        training = snapshot.status == "training"
        what = tr("pause") if training else tr("train until the schedule ends")
        tip = untrainable or with_keys(what, "training.toggle")
        if training:
            if button(ui, _label(PAUSE), "training.pause", tip=tip):
                yield Pause()
        elif button(ui, _label(START), "training.start", enabled=can_train, tip=tip):
            yield Train()
        same_line_if_fits(_label(STEP))
        tip = untrainable or with_keys(tr("one step"), "training.step")
        if button(ui, _label(STEP), "training.step", enabled=can_train, tip=tip):
            yield Train(steps=1)
        same_line_if_fits(_label(RESET))
        asking = self._reset.asking  # a tooltip would cover the question
        tip = "" if asking else tr("forget the weights and start again")
        if button(ui, _label(RESET), "training.reset", enabled=snapshot.step > 0, tip=tip):
            self._reset.asking = True
        question = trn("This forgets {n} trained step.", "This forgets {n} trained steps.", snapshot.step)
        answer = self._reset.ask(ui, question, "start again", "training.reset", needed=snapshot.step > 0)
        if answer:
            yield Reset() if answer == "forget" else saved_first(state, Reset())

    def _time_share(self, ui: Ui, snapshot: Snapshot) -> Iterator[Action]:
        if self._share is not None and abs(self._share - snapshot.wanted_share) < 1e-6:
            self._share = None
        percent = 100 * (self._share if self._share is not None else snapshot.wanted_share)
        text = tr("training gets {percent} %")
        label = text.format(percent=f"{percent:.0f}")
        field_width(ui, text.format(percent=95))
        clamp = imgui.SliderFlags_.always_clamp
        changed, percent = imgui.slider_float(f"{label}###share", percent, 5, 95, "", clamp)
        ui.mark("training.share")
        tip = tr("of the time while there are pictures to draw; the pictures and the window's frames share the rest")
        if snapshot.status == "training":
            tip = tr(
                "of the time while there are pictures to draw; now it has {percent} %; the pictures and the window's "
                "frames share the rest"
            ).format(percent=f"{100 * snapshot.train_share:.0f}")
        imgui.set_item_tooltip(tip)
        if changed:
            self._share = percent / 100
        if imgui.is_item_deactivated_after_edit() and self._share is not None:
            yield SetShare(self._share, snapshot.share_rule)
        names = list(SHARES.names())
        if len(names) > 1:
            field_width(ui, tr("rule"))
            at = names.index(snapshot.share_rule)
            changed, at = imgui.combo(f"{tr('rule')}###rule", at, [tr(SHARES.get(name).label) for name in names])
            ui.mark("training.rule")
            imgui.set_item_tooltip(tr(SHARES.get(names[at]).tip))
            if changed:
                yield SetShare(snapshot.wanted_share, names[at])

    def _checkpoint(self, ui: Ui, state: AppState) -> Iterator[Action]:
        save, load = _label(SAVE), _label(LOAD)
        field_beside(ui, save, load)
        _, state.checkpoint_file = imgui.input_text_with_hint(
            "##checkpoint", tr("a checkpoint's file"), state.checkpoint_file
        )
        ui.mark("training.checkpoint")
        path, unsaved = state.checkpoint_file.strip(), unsaved_steps(state.snapshot)
        same_line_if_fits(save)
        if button(ui, save, "training.save", tip=with_keys(tr("all that training needs to go on"), "file.save")):
            yield from run("file.save", state)
        same_line_if_fits(load)
        tip = "" if self._load.asking else tr("go on from this checkpoint")
        pressed = button(ui, load, "training.load", enabled=bool(path), tip=tip)
        if pressed and not exists(Path(path)):
            unsaved = 0  # nothing is forgotten, and the worker says what is wrong
        self._load.asking = self._load.asking or pressed
        question = trn(
            "Loading forgets {n} unsaved training step.", "Loading forgets {n} unsaved training steps.", unsaved
        )
        answer = self._load.ask(ui, question, "load", "training.load", needed=unsaved > 0)
        if answer or (pressed and unsaved == 0):
            loading = LoadCheckpoint(Path(path))
            yield saved_first(state, loading) if answer == "save" else loading


def _label(button: tuple[str, str]) -> str:
    """A button's label of its icon and its text."""
    return f"{button[0]}  {tr(button[1])}"


def _progress(ui: Ui, s: Snapshot) -> tuple[str, ImVec4]:
    steps = tr("{step} of {total} steps").format(step=figure(s.step, ","), total=figure(s.total_steps, ","))
    if s.status == "finished" and (untrainable := tr(nothing_to_train_in(s))):
        return f"{untrainable[0].upper()}{untrainable[1:]}.", ui.theme.muted
    training = tr("Training: {steps}").format(steps=steps)
    if s.seconds_left is not None:
        training = tr("Training: {steps}, {time} left").format(steps=steps, time=tr(duration(s.seconds_left)))
    finished = phrases(
        "Finished: {n:,} step in {time}", "Finished: {n:,} steps in {time}", s.step, time=duration(s.seconds)
    )
    return {
        "empty": (tr("Nothing to train yet: open a scene."), ui.theme.muted),
        "loading": (tr("Training can start once the scene is loaded."), ui.theme.muted),
        "ready": (tr("Ready: {steps}").format(steps=steps), ui.theme.text),
        "training": (training, ui.theme.text),
        "paused": (tr("Paused: {steps}").format(steps=steps), ui.theme.text),
        "finished": (tr(finished), ui.theme.good),
        "failed": (tr("Stopped by an error after {steps}: see Notices.").format(steps=steps), ui.theme.error),
    }[s.status]


def _rows(s: Snapshot) -> list[Row]:
    speed = phrase("{rate} rays/s", rate=rate(s.rays_per_second))
    rows: list[Row] = [(tr("speed"), speed), (tr("trained"), duration(s.seconds))]
    if s.corrections is not None:
        rows.append((tr("poses"), s.corrections.summary()))
    return rows
