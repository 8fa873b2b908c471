"""The Lab panel: the lecture's studies, a tab each, with their options, progress, pictures and tables."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui, implot
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.configs import constants
from nerf_core.common.language import marked, tr
from nerf_core.common.text import duration
from nerf_core.common.user_paths import own_path
from nerf_core.lab.records import Curve, Look, StudyState, Table
from nerf_core.lab.study import STUDIES, Study, takes_photo
from nerf_core.live.messages import CancelStudy, StartStudy, TurnKnob

from ..draw.opaque import OpaquePictures
from ..model.state import Action, AppState
from ..ui.axes import axis_name, fitted_axes
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, field_width, hint, mono, path_line, rounded, shown

START, CANCEL = marked("Start"), marked("Cancel")
FORM_EM, RUNNING_EM = 18.0, 13.0  # width of the options, and of the progress while the study runs
BESIDE_EM = 40.0  # width of the panel from which they are beside what is shown
LOOK_EM = 5.2  # least width of a picture
WIDE = 50  # a slider over a wider range is logarithmic
PLOT_EM = 9.0  # height of a plot
SIGNS = {
    "waiting": icons.ICON_FA_HOURGLASS,
    "running": icons.ICON_FA_PLAY,
    "done": icons.ICON_FA_CHECK,
    "failed": icons.ICON_FA_TRIANGLE_EXCLAMATION,
}
OPTIONS = (
    marked("budget"), marked("calls"), marked("cameras"), marked("coarse"), marked("directions"), marked("fine"),
    marked("frequencies"), marked("lpips weights"), marked("method"), marked("methods"), marked("noise"),
    marked("preset"), marked("rows"), marked("seed"), marked("seeds"), marked("sides"), marked("sigma"),
    marked("size"), marked("steps"), marked("views"),
)  # fmt: skip  # names of the studies' options, for the catalogues
PLOT = implot.Flags_.no_title | implot.Flags_.no_menus | implot.Flags_.no_mouse_text


@PANELS.register("lab")
class LabPanel:
    title = marked("Lab")
    dock: Literal["bottom"] = "bottom"
    order = 5

    def __init__(self) -> None:
        self._values: dict[str, dict[str, str]] = {}  # the changed options of each study, as text
        self._folders: dict[str, str] = {}
        self._photo = ""
        self._turned: dict[str, float] = {}  # knobs until the worker has taken them
        self._began = ""  # the study whose tab came to the front when it began

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if state.snapshot.status == "loading" and not state.snapshot.loaded:
            hint(ui, tr("Studies of the lecture's claims: they appear when PyTorch is loaded."))
            return
        if not imgui.begin_tab_bar("studies"):
            return
        for name in sorted(STUDIES.names(), key=lambda name: STUDIES.get(name).order):
            kind, flags = STUDIES.get(name), imgui.TabItemFlags_.none
            study = state.snapshot.study
            running = study.name if study is not None and study.state == "running" else ""
            if running == name != self._began:
                flags = imgui.TabItemFlags_.set_selected
            if running in (name, ""):
                self._began = running
            shown, _ = imgui.begin_tab_item(f"{tr(kind.title)}###{name}", None, flags)
            ui.mark(f"lab.{name}")
            if shown:
                yield from self._study(ui, state, name, kind)
                imgui.end_tab_item()
        imgui.end_tab_bar()

    def _study(self, ui: Ui, state: AppState, name: str, kind: type[Study]) -> Iterator[Action]:
        avail, study = imgui.get_content_region_avail(), state.snapshot.study
        beside = avail.x > BESIDE_EM * ui.em
        running = study is not None and study.name == name and study.state == "running"
        wide = (RUNNING_EM if running else FORM_EM) * ui.em
        imgui.begin_child(f"form {name}", ImVec2(wide if beside else 0.0, 0.0 if beside else avail.y * 0.5))
        yield from self._form(ui, state, name, kind)
        imgui.end_child()
        if beside:
            imgui.same_line(0, ui.em)
        imgui.begin_child(f"shown {name}", ImVec2(0, 0))
        if study is None or study.name != name:
            hint(ui, tr(kind.summary))
        else:
            _shown(ui, study)
        imgui.end_child()

    # ---- options ----------------------------------------------------------------------------------------------------

    def _form(self, ui: Ui, state: AppState, name: str, kind: type[Study]) -> Iterator[Action]:
        study, scene = state.snapshot.study, state.snapshot.scene
        running = study is not None and study.state == "running"
        own = study if study is not None and study.name == name else None
        if running and own is not None:
            imgui.progress_bar(own.fraction, ImVec2(-1, 0), f"{100 * own.fraction:.0f} %")
            ui.mark("lab.progress")
            text = tr(own.text)
            if own.seconds_left is not None:
                text = tr("{what}, {time} left").format(what=text, time=tr(duration(own.seconds_left)))
            hint(ui, text)
            cancel = f"{icons.ICON_FA_XMARK}  {tr(CANCEL)}"
            if button(ui, cancel, "lab.cancel", tip=tr("what is done stays in the folder; Start goes on from there")):
                yield CancelStudy()
            yield from self._knobs(ui, own)
            return
        if own is not None:
            _ended(ui, own)
        folder = self._folders.get(name, "")
        default = f"lab/{scene.name}-{name}" if kind.of_scene and scene is not None else f"lab/{name}"
        possible = not running and (scene is not None or not kind.of_scene)
        tip = tr("training and the window go on meanwhile")
        if not possible:
            tip = tr("another study runs: wait for it or cancel it") if running else tr("open a scene first")
        if button(ui, f"{icons.ICON_FA_FLASK}  {tr(START)}", f"lab.start.{name}", enabled=possible, tip=tip):
            photo = own_path(Path(self._photo.strip())) if self._photo.strip() and takes_photo(kind) else None
            where = own_path(Path(folder.strip() or default))
            self._turned.clear()
            yield StartStudy(name, dict(self._values.get(name, {})), where, photo)
        self._options(ui, name, kind)
        if takes_photo(kind):
            label, tip, usual = tr("photo"), tr("a photo's file"), tr("the built-in picture")
            self._photo = _text(ui, label, self._photo, usual, f"lab.{name}.photo", tip)
        label, tip = tr("folder"), tr("where the report goes")
        self._folders[name] = _text(ui, label, folder, default, f"lab.{name}.folder", tip)

    def _options(self, ui: Ui, name: str, kind: type[Study]) -> None:
        """A field for each constant of the study: empty means its default, which is shown in it."""
        values = self._values.setdefault(name, {})
        for key, (default, about) in constants(kind).items():
            label = tr(key.replace("_", " "))
            text = _text(ui, label, values.get(key, ""), str(default), f"lab.{name}.{key}", tr(about.help))
            values.pop(key, None)
            if text.strip():
                values[key] = text.strip()

    def _knobs(self, ui: Ui, study: StudyState) -> Iterator[Action]:
        """Sliders for what may be turned while the study runs."""
        for knob in study.knobs:
            if knob.of_view:
                continue  # a panel of its own has it
            field_width(ui, tr(knob.name))
            value = self._turned.get(knob.name, knob.value)
            whole = all(v == round(v) for v in (knob.value, knob.least, knob.most))
            spec = ".0f" if whole else ".3g"
            flags = imgui.SliderFlags_.logarithmic if knob.most > WIDE * knob.least > 0 else imgui.SliderFlags_.none
            label = f"{tr(knob.name)}###knob {knob.name}"
            changed, value = imgui.slider_float(label, value, knob.least, knob.most, shown(value, spec), flags)
            ui.mark(f"lab.knob.{knob.name}")
            if changed:
                self._turned[knob.name] = rounded(value, spec)
            if imgui.is_item_deactivated_after_edit():
                yield TurnKnob(knob.name, self._turned[knob.name])


def _text(ui: Ui, label: str, value: str, default: str, mark: str, tip: str) -> str:
    field_width(ui, label)
    _, value = imgui.input_text_with_hint(f"{label}###{mark}", default, value)
    ui.mark(mark)
    imgui.set_item_tooltip(f"{tip[0].upper()}{tip[1:]}.")
    return value


def _ended(ui: Ui, study: StudyState) -> None:
    if study.state == "done":
        hint(ui, tr("Done:"), ui.theme.good)
        for file in study.files[:1]:
            path_line(ui, file, "lab.copy")
    elif study.state == "cancelled":
        hint(ui, tr("Cancelled. Start goes on from what is done."))
    else:
        hint(ui, tr("The study failed: see Notices."), ui.theme.error)


# ---- what is shown ------------------------------------------------------------------------------------------------


def _shown(ui: Ui, study: StudyState) -> None:
    _looks(ui, study.looks)
    if study.curves:
        _curves(ui, study.curves)
    if not study.tables:
        _rows(ui, study)
    for k, table in enumerate(study.tables):
        _table(ui, table, k)
    if study.tables and study.state == "running":
        _rows(ui, study)
    for figure in study.figures:
        room = imgui.get_content_region_avail().x
        high, wide = figure.image.shape[:2]
        width = min(room, wide * ui.em / 16)  # figures have 160 pixels an inch
        imgui.image(_texture(ui, figure), ImVec2(width, width * high / wide))
        ui.mark(f"lab.figure.{figure.name}")


def _rows(ui: Ui, study: StudyState) -> None:
    colors = {"waiting": ui.theme.muted, "running": ui.theme.accent, "done": ui.theme.good, "failed": ui.theme.error}
    for row in study.rows:
        imgui.text_colored(colors[row.state], SIGNS[row.state])
        imgui.same_line(0, 0.5 * ui.em)
        imgui.text_unformatted(tr(row.label))
        if row.text:
            imgui.same_line(0, ui.em)
            hint(ui, tr(row.text))


def _looks(ui: Ui, looks: tuple[Look, ...]) -> None:
    """Pictures side by side, as many in a line as fit, all of one width."""
    if not looks:
        return
    room, gap = imgui.get_content_region_avail().x, 0.5 * ui.em
    most = max(1, min(len(looks), int((room + gap) // (LOOK_EM * ui.em + gap))))
    columns = -(-len(looks) // -(-len(looks) // most))  # lines of equal length: what belongs together stays in line
    width = min((room + gap) / columns - gap, 16 * ui.em)
    for k, look in enumerate(looks):
        if k % columns:
            imgui.same_line(0, gap)
        imgui.begin_group()
        high, wide = look.image.shape[:2]
        imgui.image(_texture(ui, look), ImVec2(width, width * high / wide))
        ui.mark(f"lab.look.{look.name}")
        imgui.push_text_wrap_pos(imgui.get_cursor_pos_x() + width)
        imgui.text_unformatted(tr(look.name))
        imgui.text_colored(ui.theme.muted, tr(look.note) or " ")
        imgui.pop_text_wrap_pos()
        imgui.end_group()


_OPAQUE = OpaquePictures()


def _texture(ui: Ui, look: Look) -> imgui.ImTextureRef:
    return ui.texture(f"lab {look.name}", _OPAQUE.rgba(look.name, look.image))


def _curves(ui: Ui, curves: tuple[Curve, ...]) -> None:
    implot.push_style_var(implot.StyleVar_.plot_min_size, ImVec2(ui.em, ui.em))
    if implot.begin_plot("##curves", ImVec2(-1, PLOT_EM * ui.em), PLOT):
        fitted_axes([(curve.x, curve.y) for curve in curves])
        implot.setup_legend(implot.Location_.south_east)
        for k, curve in enumerate(curves):
            color = ui.theme.pins[k % len(ui.theme.pins)]
            line = implot.Spec(line_color=color, line_weight=0.12 * ui.em)
            implot.plot_line(
                f"{tr(curve.name)}###{curve.name}", curve.x.astype(np.float64), curve.y.astype(np.float64), line
            )
        axis_name(ui, tr("PSNR of held-out pixels (dB) over steps"), right=True)
        implot.end_plot()
        ui.mark("lab.curves")
    implot.pop_style_var()


def _table(ui: Ui, table: Table, k: int) -> None:
    imgui.text_unformatted(tr(table.title))
    flags = imgui.TableFlags_.row_bg | imgui.TableFlags_.borders_inner_h | imgui.TableFlags_.sizing_fixed_fit
    flags |= imgui.TableFlags_.scroll_x
    lines = len(table.rows) + 1
    high = lines * imgui.get_text_line_height_with_spacing() * 1.25 + imgui.get_style().scrollbar_size
    if imgui.begin_table(f"table {k}", len(table.columns), flags, ImVec2(0, high)):
        for column, name in enumerate(table.columns):
            imgui.table_setup_column(f"{tr(name)}###{column}")
        imgui.table_headers_row()
        for row in table.rows:
            imgui.table_next_row()
            for column, text in enumerate(row):
                imgui.table_next_column()
                if column:
                    with mono(ui):
                        imgui.text_unformatted(tr(text))
                else:
                    imgui.text_unformatted(tr(text))
        imgui.end_table()
    for note in table.notes:
        hint(ui, tr(note))
