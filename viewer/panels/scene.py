"""The scene panel: photos, splits, bounds and warnings; opening another capture; stepping through photos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from nerf_core.common.configs import Constant, constants
from nerf_core.common.errors import UserError
from nerf_core.common.text import counted, number
from nerf_core.common.user_paths import own_path
from nerf_core.datasets.recognise import recognise
from nerf_core.geometry.scene import SPLITS, Scene
from nerf_core.live.messages import CancelLoading, OpenScene, UseMethod
from nerf_core.methods import METHODS

from ..commands.actions.files import saved_first
from ..commands.registry import USER_COMMANDS, run, with_keys
from ..model.state import Action, AppState, unsaved_steps
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Forgetting, Row, button, field_beside, field_width, figures, hint, same_line_if_fits

DOWNSCALE, MOST = "downscale", 64
OPEN, PAUSED, DEMO = f"{icons.ICON_FA_FOLDER_OPEN}  Open and train", "Open paused", "Demo"
CANCEL = f"{icons.ICON_FA_XMARK}  Cancel"


@PANELS.register("scene")
class ScenePanel:
    title = "Scene"
    dock: Literal["right"] = "right"
    order = 0

    def __init__(self) -> None:
        self._confirmation, self._change = Forgetting(), Forgetting()
        self._other = ""  # the method of the second confirmation
        self._wanted: Path | None = None  # the capture of the confirmation; None: the demo scene
        self._train = True  # whether to train it

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        snapshot, scene = state.snapshot, state.snapshot.scene
        yield from self._open(ui, state)
        if snapshot.status == "loading":
            words = snapshot.loading or "loading …"
            hint(ui, words[:1].upper() + words[1:], ui.theme.accent)
            if button(ui, CANCEL, "scene.cancel", tip="stop loading; what is open stays open"):
                yield CancelLoading()
        elif scene is None:
            hint(ui, "No scene is open. Type the folder of a capture, or open the demo scene.")
            _offer_methods(ui, state)
        if scene is not None:
            figures(ui, "scene", _rows(scene))
            yield from _photos(ui, state, scene)
            same_line_if_fits(f"{DOWNSCALE}  00")
        _downscale(ui, state)
        if scene is not None:
            yield from self._method(ui, state)
            _constants(ui, state)
            for note in scene.notes:
                hint(ui, f"{icons.ICON_FA_TRIANGLE_EXCLAMATION}  {note}", ui.theme.warning)

    def _open(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if state.focus_open and not state.raise_panel:
            imgui.set_keyboard_focus_here()
            state.focus_open = False
        field_beside(ui, OPEN)
        flags = imgui.InputTextFlags_.enter_returns_true
        entered, state.open_path = imgui.input_text_with_hint("##path", "folder of a capture", state.open_path, flags)
        ui.mark("scene.path")
        same_line_if_fits(OPEN)
        path = state.open_path.strip()
        if (button(ui, OPEN, "scene.open", enabled=bool(path)) or entered) and path:
            yield from self._ask(state, Path(path), train=True)
        asking = self._confirmation.asking  # a tooltip would cover the question
        tip = "" if asking else "show the photos and cameras first; Train begins"
        if button(ui, PAUSED, "scene.open_paused", enabled=bool(path), tip=tip) and path:
            yield from self._ask(state, Path(path), train=False)
        same_line_if_fits(DEMO)
        if button(ui, DEMO, "scene.demo", tip="" if asking else "open the demo scene and train"):
            yield from self._ask(state, None, train=True)
        unsaved = unsaved_steps(state.snapshot)
        question = f"Opening another scene forgets {counted(unsaved, 'unsaved training step')}."
        answer = self._confirmation.ask(ui, question, "open", "scene.open", needed=unsaved > 0)
        if answer:
            opening = OpenScene(self._wanted, state.settings, train=self._train)
            yield opening if answer == "forget" else saved_first(state, opening)

    def _method(self, ui: Ui, state: AppState) -> Iterator[Action]:
        """The method of the open scene, and a choice of another."""
        snapshot, unsaved = state.snapshot, unsaved_steps(state.snapshot)
        wanted = ""
        field_width(ui, "method")
        if imgui.begin_combo("method", snapshot.method, imgui.ComboFlags_.height_largest):
            for name, sentence in method_sentences().items():
                chosen, _ = imgui.selectable(f"{name}##method", name == snapshot.method)
                ui.mark(f"scene.method.{name}")
                imgui.set_item_tooltip(sentence)
                if chosen and name != snapshot.method:
                    wanted = self._other = name
            imgui.end_combo()
        ui.mark("scene.method")
        why = f" ({snapshot.method_reason})" if snapshot.method_reason else ""
        imgui.set_item_tooltip(method_sentences().get(snapshot.method, "") + why)
        self._change.asking = self._change.asking or (bool(wanted) and unsaved > 0)
        question = f"Changing to {self._other} forgets {counted(unsaved, 'unsaved training step')}."
        answer = self._change.ask(ui, question, "change", "scene.method", needed=unsaved > 0)
        if answer or (wanted and unsaved == 0):
            changing = UseMethod(self._other, train=True)
            yield saved_first(state, changing) if answer == "save" else changing

    def _ask(self, state: AppState, path: Path | None, train: bool) -> Iterator[Action]:
        self._wanted, self._train = path, train
        self._confirmation.asking = unsaved_steps(state.snapshot) > 0 and _can_be_opened(path, state)
        if not self._confirmation.asking:
            yield OpenScene(path, state.settings, train=train)


def _can_be_opened(path: Path | None, state: AppState) -> bool:
    """Whether there is a capture. Without one nothing is forgotten, and the worker says what is wrong."""
    try:
        recognise(None if path is None else own_path(path), state.settings.load.format)
    except (UserError, OSError):
        return False
    return True


def _rows(scene: Scene) -> list[Row]:
    counts = [f"{len(scene.split(name)):,} {name}" for name in SPLITS if scene.split(name)]
    sizes = sorted({(v.camera.width, v.camera.height) for v in scene.views})
    size = f"{sizes[0][0]:,} × {sizes[0][1]:,}" if len(sizes) == 1 else f"{len(sizes):,} sizes"
    if len(sizes) > 1:
        size += f", up to {max(w for w, _ in sizes):,} × {max(h for _, h in sizes):,}"
    return [
        ("name", scene.name),
        ("format", f"{scene.format}, in NDC" if scene.ndc is not None else scene.format),
        ("photos", " · ".join(counts) or "none"),
        ("size", f"{size} px" if sizes else "–"),
        ("near … far", f"{number(scene.near)} … {number(scene.far)} units"),
    ]


@cache
def method_sentences() -> dict[str, str]:
    return {name: METHODS.get(name).summary for name in METHODS.names()}


def _constants(ui: Ui, state: AppState) -> None:
    """The constants of the open model, read-only; a tooltip has the range and a line of help."""
    opened = imgui.tree_node_ex("Constants", imgui.TreeNodeFlags_.span_avail_width)
    ui.mark("scene.constants")
    if not opened:
        return
    values, known = state.snapshot.config, _known_constants(state.snapshot.method)
    if imgui.begin_table("constants", 2, imgui.TableFlags_.sizing_stretch_prop):
        for name, (_, about) in known.items():
            imgui.table_next_column()
            imgui.text_colored(ui.theme.muted, name)
            limits = f"\n{about.range}" if about.range else ""
            imgui.set_item_tooltip(f"{about.help}{limits}")
            imgui.table_next_column()
            imgui.text_unformatted(_value(values, name))
        imgui.end_table()
    imgui.tree_pop()


def _value(values: Mapping[str, Any], name: str) -> str:
    """The value of a constant; a nested one is named outer.inner."""
    outer, _, inner = name.partition(".")
    value = values.get(outer, {}).get(inner) if inner else values.get(name)
    return f"{value:g}" if isinstance(value, float) else str(value)


@cache
def _known_constants(method: str) -> dict[str, tuple[Any, Constant]]:
    return constants(METHODS.get(method).constants) if method in METHODS.names() else {}


def _offer_methods(ui: Ui, state: AppState) -> None:
    """The method for the next capture: a box with a sentence on each."""
    offers, chosen = {"auto": "The one that is fast on this device."} | method_sentences(), state.settings.method
    field_width(ui, "method")
    if imgui.begin_combo("method##start", chosen, imgui.ComboFlags_.height_largest):
        column = max(imgui.calc_text_size(name).x for name in offers) + 1.5 * ui.em
        for name, sentence in offers.items():
            pressed, _ = imgui.selectable(f"{name}##start", name == chosen)
            ui.mark(f"scene.start.{name}")
            imgui.same_line(column)
            imgui.text_colored(ui.theme.muted, sentence)
            if pressed:
                state.settings = replace(state.settings, method=name, preset="auto", changes={})
        imgui.end_combo()
    ui.mark("scene.start")
    hint(ui, offers.get(chosen, ""))


def _downscale(ui: Ui, state: AppState) -> None:
    load = state.settings.load
    imgui.set_next_item_width(2.6 * ui.em)
    _, value = imgui.drag_int(DOWNSCALE, load.downscale, 0.05, 1, MOST, "%d", imgui.SliderFlags_.always_clamp)
    ui.mark("scene.downscale")
    imgui.set_item_tooltip("of the capture that is opened next: its photos are averaged over so many pixels a side")
    state.settings = replace(state.settings, load=replace(load, downscale=value))


def _photos(ui: Ui, state: AppState, scene: Scene) -> Iterator[Action]:
    """Buttons that step through the training photos like the arrow keys."""
    train, current = scene.split("train"), state.current_view
    for icon, direction in ((icons.ICON_FA_CHEVRON_LEFT, "previous"), (icons.ICON_FA_CHEVRON_RIGHT, "next")):
        go = f"camera.{direction}"
        tip = with_keys(f"{direction} training photo", go)
        if button(ui, icon, f"scene.{direction}", enabled=USER_COMMANDS.get(go).enabled(state), tip=tip):
            yield from run(go, state)
        imgui.same_line()
    imgui.align_text_to_frame_padding()
    if current in train and current is not None:
        imgui.text_unformatted(f"photo {train.index(current) + 1:,} of {len(train):,}")
        imgui.set_item_tooltip(scene.views[current].name)
    else:
        imgui.text_colored(ui.theme.muted, f"{len(train):,} training photos")
