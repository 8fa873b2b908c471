"""The scene panel: photos, splits, bounds and warnings; opening another capture; stepping through photos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from nerf_core.captures.raw_photos import raw_photos
from nerf_core.common.configs import Constant, constants
from nerf_core.common.errors import UserError
from nerf_core.common.language import figure, marked, phrase, phrases, tr, trn
from nerf_core.common.text import duration, number
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

DOWNSCALE, MOST = marked("downscale"), 64
OPEN, PAUSED, DEMO, CANCEL = marked("Open and train"), marked("Open paused"), marked("Demo"), marked("Cancel")
PHOTOS = {"train": marked("{n} train"), "val": marked("{n} val"), "test": marked("{n} test")}  # of the splits
FASTEST = marked("The one that is fast on this device.")


@PANELS.register("scene")
class ScenePanel:
    title = marked("Scene")
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
            words = tr(snapshot.loading) or tr("loading …")
            hint(ui, words[:1].upper() + words[1:], ui.theme.accent)
            cancel = f"{icons.ICON_FA_XMARK}  {tr(CANCEL)}"
            if button(ui, cancel, "scene.cancel", tip=tr("stop loading; what is open stays open")):
                yield CancelLoading()
        elif scene is None:
            hint(ui, tr("No scene is open. Type the folder of a capture, or open the demo scene."))
            _offer_methods(ui, state)
        if scene is not None:
            figures(ui, "scene", _rows(scene))
            yield from _photos(ui, state, scene)
            same_line_if_fits(f"{tr(DOWNSCALE)}  00")
        _downscale(ui, state)
        if scene is not None:
            yield from self._method(ui, state)
            _constants(ui, state)
            for note in scene.notes:
                hint(ui, f"{icons.ICON_FA_TRIANGLE_EXCLAMATION}  {tr(note)}", ui.theme.warning)

    def _open(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if state.focus_open and not state.raise_panel:
            imgui.set_keyboard_focus_here()
            state.focus_open = False
        train, demo = f"{icons.ICON_FA_FOLDER_OPEN}  {tr(OPEN)}", tr(DEMO)
        field_beside(ui, train)
        flags, usual = imgui.InputTextFlags_.enter_returns_true, tr("folder of a capture")
        entered, state.open_path = imgui.input_text_with_hint("##path", usual, state.open_path, flags)
        ui.mark("scene.path")
        same_line_if_fits(train)
        path = state.open_path.strip()
        if (button(ui, train, "scene.open", enabled=bool(path)) or entered) and path:
            yield from self._ask(state, Path(path), train=True)
        asking = self._confirmation.asking  # a tooltip would cover the question
        tip = "" if asking else tr("show the photos and cameras first; Train begins")
        if button(ui, tr(PAUSED), "scene.open_paused", enabled=bool(path), tip=tip) and path:
            yield from self._ask(state, Path(path), train=False)
        same_line_if_fits(demo)
        if button(ui, demo, "scene.demo", tip="" if asking else tr("open the demo scene and train")):
            yield from self._ask(state, None, train=True)
        unsaved = unsaved_steps(state.snapshot)
        question = trn(
            "Opening another scene forgets {n} unsaved training step.",
            "Opening another scene forgets {n} unsaved training steps.",
            unsaved,
        )
        answer = self._confirmation.ask(ui, question, "open", "scene.open", needed=unsaved > 0)
        if answer:
            opening = OpenScene(self._wanted, state.settings, train=self._train)
            yield opening if answer == "forget" else saved_first(state, opening)

    def _method(self, ui: Ui, state: AppState) -> Iterator[Action]:
        """The method of the open scene, and a choice of another."""
        snapshot, unsaved = state.snapshot, unsaved_steps(state.snapshot)
        wanted = ""
        field_width(ui, tr("method"))
        if imgui.begin_combo(f"{tr('method')}###method", snapshot.method, imgui.ComboFlags_.height_largest):
            for name, sentence in method_sentences().items():
                chosen, _ = imgui.selectable(f"{name}##method", name == snapshot.method)
                ui.mark(f"scene.method.{name}")
                imgui.set_item_tooltip(tr(sentence))
                if chosen and name != snapshot.method:
                    wanted = self._other = name
            imgui.end_combo()
        ui.mark("scene.method")
        why = f" ({tr(snapshot.method_reason)})" if snapshot.method_reason else ""
        imgui.set_item_tooltip(tr(method_sentences().get(snapshot.method, "")) + why)
        self._change.asking = self._change.asking or (bool(wanted) and unsaved > 0)
        question = phrases(
            "Changing to {method} forgets {n:,} unsaved training step.",
            "Changing to {method} forgets {n:,} unsaved training steps.",
            unsaved,
            method=self._other,
        )
        answer = self._change.ask(ui, tr(question), "change", "scene.method", needed=unsaved > 0)
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
        if path is None or raw_photos(own_path(path)) is None:
            recognise(None if path is None else own_path(path), state.settings.load.format)
    except (UserError, OSError):
        return False
    return True


def _rows(scene: Scene) -> list[Row]:
    known = {name: len(scene.split(name)) for name in SPLITS}
    counts = [tr(PHOTOS[name]).format(n=figure(count, ",")) for name, count in known.items() if count]
    sizes = scene.photo_sizes
    width, height = max((w for w, _ in sizes), default=0), max((h for _, h in sizes), default=0)
    size = phrase("{width:,} × {height:,} px", width=width, height=height) if sizes else "–"
    if len(sizes) > 1:
        size = phrases(
            "{n:,} size, up to {width:,} × {height:,} px",
            "{n:,} sizes, up to {width:,} × {height:,} px",
            len(sizes),
            width=width,
            height=height,
        )
    bounds = phrase("{near} … {far} units", near=number(scene.near), far=number(scene.far))
    masked = [(tr("masks"), _masks(scene))] if scene.photos.kept is not None else []
    reading = scene.photos.reading()
    read = [(tr("read"), _read(*reading))] if reading is not None else []
    return [
        (tr("name"), scene.name),
        (tr("format"), phrase("{format}, in NDC", format=scene.format) if scene.ndc is not None else scene.format),
        (tr("photos"), " · ".join(counts) or tr("none")),
        (tr("size"), size),
        *masked,
        *read,
        (tr("near … far"), bounds),
    ]


def _read(done: int, total: int, seconds: float | None) -> str:
    """How many photos of a large capture are read, and how long the rest takes."""
    if seconds is None:
        return phrase("{done:,} of {total:,}", done=done, total=total)
    return phrase("{done:,} of {total:,}, {time} left", done=done, total=total, time=duration(seconds))


def _masks(scene: Scene) -> str:
    """How many photos have masked pixels."""
    masked, photos = len(scene.photos.masked_photos), len(scene.views)
    return phrase("{n:,} of {photos:,} photos", n=masked, photos=photos)


@cache
def method_sentences() -> dict[str, str]:
    return {name: METHODS.get(name).summary for name in METHODS.names()}


def _constants(ui: Ui, state: AppState) -> None:
    """The constants of the open model, read-only; a tooltip has the range and a line of help."""
    opened = imgui.tree_node_ex(f"{tr('Constants')}###constants", imgui.TreeNodeFlags_.span_avail_width)
    ui.mark("scene.constants")
    if not opened:
        return
    values, known = state.snapshot.config, _known_constants(state.snapshot.method)
    if imgui.begin_table("constants", 2, imgui.TableFlags_.sizing_stretch_prop):
        for name, (_, about) in known.items():
            imgui.table_next_column()
            imgui.text_colored(ui.theme.muted, name)
            limits = f"\n{tr(about.range)}" if about.range else ""
            imgui.set_item_tooltip(f"{tr(about.help)}{limits}")
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
    offers, chosen = {"auto": FASTEST} | method_sentences(), state.settings.method
    field_width(ui, tr("method"))
    if imgui.begin_combo(f"{tr('method')}###start", chosen, imgui.ComboFlags_.height_largest):
        column = max(imgui.calc_text_size(name).x for name in offers) + 1.5 * ui.em
        for name, sentence in offers.items():
            pressed, _ = imgui.selectable(f"{name}##start", name == chosen)
            ui.mark(f"scene.start.{name}")
            imgui.same_line(column)
            imgui.text_colored(ui.theme.muted, tr(sentence))
            if pressed:
                state.settings = replace(state.settings, method=name, preset="auto", changes={})
        imgui.end_combo()
    ui.mark("scene.start")
    hint(ui, tr(offers.get(chosen, "")))


def _downscale(ui: Ui, state: AppState) -> None:
    load = state.settings.load
    imgui.set_next_item_width(2.6 * ui.em)
    label, clamp = f"{tr(DOWNSCALE)}###downscale", imgui.SliderFlags_.always_clamp
    _, value = imgui.drag_int(label, load.downscale, 0.05, 1, MOST, "%d", clamp)
    ui.mark("scene.downscale")
    imgui.set_item_tooltip(tr("of the capture that is opened next: its photos are averaged over so many pixels a side"))
    state.settings = replace(state.settings, load=replace(load, downscale=value))


def _photos(ui: Ui, state: AppState, scene: Scene) -> Iterator[Action]:
    """Buttons that step through the training photos like the arrow keys."""
    train, current = scene.split("train"), state.current_view
    for icon, direction in ((icons.ICON_FA_CHEVRON_LEFT, "previous"), (icons.ICON_FA_CHEVRON_RIGHT, "next")):
        go = f"camera.{direction}"
        tip = with_keys(tr("next training photo") if direction == "next" else tr("previous training photo"), go)
        if button(ui, icon, f"scene.{direction}", enabled=USER_COMMANDS.get(go).enabled(state), tip=tip):
            yield from run(go, state)
        imgui.same_line()
    imgui.align_text_to_frame_padding()
    if current in train and current is not None:
        at, count = figure(train.index(current) + 1, ","), figure(len(train), ",")
        imgui.text_unformatted(tr("photo {i} of {n}").format(i=at, n=count))
        imgui.set_item_tooltip(scene.views[current].name)
    else:
        imgui.text_colored(ui.theme.muted, trn("{n} training photo", "{n} training photos", len(train)))
