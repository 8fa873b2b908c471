"""The offer to continue where one left off: the autosaves, with what they take and a way to delete them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, phrases, tr, trn
from nerf_core.common.names import printable
from nerf_core.common.text import duration, size
from nerf_core.live.messages import OpenScene
from nerf_core.training.autosaves import Autosave

from ..commands.actions.files import saved_first
from ..commands.registry import USER_COMMANDS, run, with_keys
from ..model.state import Action, AppState, ClearAutosaves, unsaved_steps
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Confirmation, Forgetting, button, hint, keep_in_front, packed, same_line_if_fits

WIDTH_EM, PICTURE_EM, GAP_EM = 42.0, (8.0, 5.0), 0.7
ROOM_EM = 28.0, 24.0  # the least space for it over the picture
SPARE_EM = 12.0  # of the height, for what stands around the list
LEAST_ROWS = 1.4  # of the list: half a row says that there are more
MONTHS = (
    marked("Jan"), marked("Feb"), marked("Mar"), marked("Apr"), marked("May"), marked("Jun"),
    marked("Jul"), marked("Aug"), marked("Sep"), marked("Oct"), marked("Nov"), marked("Dec"),
)  # fmt: skip
FLAGS = (
    imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_nav
)  # fmt: skip


@PANELS.register("left_off")
class LeftOffOverlay:
    title = marked("Continue where you left off")
    dock: Literal["overlay"] = "overlay"
    order = 1

    def __init__(self) -> None:
        self._continue, self._clear = Forgetting(), Confirmation()
        self._wanted: Autosave | None = None

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if not state.show_left_off or state.viewport_rect is None or state.snapshot.status == "loading":
            return
        x, y, width, height = state.viewport_rect
        if width < ROOM_EM[0] * ui.em or height < ROOM_EM[1] * ui.em:  # then it also covers panels
            area = imgui.get_main_viewport()
            x, y, width, height = area.work_pos.x, area.work_pos.y, area.work_size.x, area.work_size.y
        imgui.set_next_window_pos(ImVec2(x + 0.5 * width, y + 0.5 * height), imgui.Cond_.always, ImVec2(0.5, 0.5))
        wide = min(WIDTH_EM * ui.em, width - ui.em)
        imgui.set_next_window_size_constraints(ImVec2(wide, 0), ImVec2(wide, max(height, 8 * ui.em)))
        imgui.begin("##left_off", None, FLAGS)
        keep_in_front()
        yield from self._content(ui, state, max(height - SPARE_EM * ui.em, 0.0))
        imgui.end()

    def _content(self, ui: Ui, state: AppState, room: float) -> Iterator[Action]:
        entries, asked = state.left_off.entries, self._continue.asking or self._clear.asking
        imgui.align_text_to_frame_padding()
        imgui.text_unformatted(tr(self.title))
        right = imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x
        imgui.same_line(right - imgui.get_frame_height())
        if button(ui, icons.ICON_FA_XMARK, "left_off.close", tip=with_keys(tr("File shows it again"), "file.left_off")):
            state.show_left_off = False
        if entries is None:
            hint(ui, tr("Looking for autosaves …"))
        elif not entries:
            hint(ui, tr("There are no autosaves. A window that closes writes unsaved weights to one."))
        else:
            yield from self._list(ui, state, entries, room)
            yield from self._footer(ui, entries)
        imgui.separator()
        folder = f"{icons.ICON_FA_FOLDER_OPEN}  {tr('Open a folder…')}"
        if button(ui, folder, "left_off.open", tip=with_keys("", "file.open")):
            state.show_left_off = False
            yield from run("file.open", state)
        if state.snapshot.scene is None:
            demo = tr("Demo scene")
            same_line_if_fits(demo)
            if button(ui, demo, "left_off.demo", tip=tr("open the demo scene and train")):
                yield OpenScene(None, state.settings, train=True)
            tour = f"{icons.ICON_FA_GRADUATION_CAP}  {tr(USER_COMMANDS.get('tour.begin').title)}"
            same_line_if_fits(tour)
            if button(ui, tour, "left_off.tour", tip=tr("a tour in the demo scene")):
                yield from run("tour.begin", state)
        if imgui.is_key_pressed(imgui.Key.escape, False) and not asked:  # else it closes the question
            state.show_left_off = False

    def _list(self, ui: Ui, state: AppState, entries: tuple[Autosave, ...], room: float) -> Iterator[Action]:
        row = PICTURE_EM[1] * ui.em + imgui.get_style().item_spacing.y
        tall = min(len(entries) * row, max(room, LEAST_ROWS * row))
        imgui.begin_child("list", ImVec2(0, tall))
        for number, one in enumerate(entries):
            imgui.push_id(number)  # not the path: it may not be UTF-8
            if _entry(ui, state, one, f"left_off.{number}"):
                self._wanted = one
                self._continue.asking = unsaved_steps(state.snapshot) > 0
                if not self._continue.asking:
                    yield self._opened(state, one)
            imgui.pop_id()
        imgui.end_child()
        unsaved = unsaved_steps(state.snapshot)
        question = trn(
            "Opening it forgets {n} unsaved training step.", "Opening it forgets {n} unsaved training steps.", unsaved
        )
        answer = self._continue.ask(ui, question, "open", "left_off", needed=unsaved > 0)
        if answer and self._wanted:
            opening = self._opened(state, self._wanted)
            yield opening if answer == "forget" else saved_first(state, opening)

    @staticmethod
    def _opened(state: AppState, one: Autosave) -> OpenScene:
        """The command that opens an autosave, paused. The settings are those of its own run."""
        assert one.load is not None, "what has a problem cannot be chosen"
        settings = replace(state.settings, load=one.load, method="auto", preset="auto", changes={})
        return OpenScene(one.capture, settings, checkpoint=one.file)

    def _footer(self, ui: Ui, entries: tuple[Autosave, ...]) -> Iterator[Action]:
        """What the files take, and the question before they are deleted."""
        takes = tr(
            phrases(
                "{n} autosave, {size}", "{n} autosaves, {size}", len(entries), size=size(sum(e.bytes for e in entries))
            )
        )
        question = tr("Delete {takes}? They cannot be brought back.").format(takes=takes)
        if self._clear.draw(ui, question, tr("Delete"), "left_off.clear", True):
            yield ClearAutosaves()
        if not self._clear.asking:
            imgui.align_text_to_frame_padding()
            imgui.text_colored(ui.theme.muted, takes)
            clear = tr("Clear…")
            same_line_if_fits(clear)
            tip = tr("delete the files of this list; a scene keeps its newest three and the longest trained, no more")
            self._clear.asking = button(ui, clear, "left_off.clear", tip=tip)


def _entry(ui: Ui, state: AppState, one: Autosave, mark: str) -> bool:
    """Draw an autosave. Returns whether it was clicked."""
    wide, tall = PICTURE_EM[0] * ui.em, PICTURE_EM[1] * ui.em
    at, room = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x
    imgui.begin_disabled(bool(one.problem))
    clicked, _ = imgui.selectable("##row", False, imgui.SelectableFlags_.none, ImVec2(room, tall))
    imgui.end_disabled()
    ui.mark(mark)
    if imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled | imgui.HoveredFlags_.for_tooltip):
        imgui.set_tooltip("\n".join(filter(None, (printable(one.file), tr(one.problem)))))
    draw = imgui.get_window_draw_list()
    _picture(ui, draw, state, one, at, ImVec2(at.x + wide, at.y + tall))
    theme, line = ui.theme, tall / 4
    left, most = at.x + wide + GAP_EM * ui.em, room - wide - 1.5 * GAP_EM * ui.em
    where = tr("the demo scene") if one.capture is None else printable(one.capture)
    step = tr("step {step}").format(step=figure(one.step, ","))
    trained = tr("{time} of training").format(time=tr(duration(one.seconds)))
    lines = [
        (one.scene or printable(one.file.name), theme.muted if one.problem else theme.text),
        (f"{one.method}  ·  {step}  ·  {trained}", theme.muted),
        (f"{_when(one.saved)}  ·  {tr(size(one.bytes))}", theme.muted),
        (tr(one.problem), theme.warning) if one.problem else (where, theme.muted),
    ]
    if not one.method:
        del lines[1]
    for k, (text, color) in enumerate(lines):
        place = ImVec2(int(left), int(at.y + k * line + 0.5 * (line - imgui.get_text_line_height())))
        draw.add_text(place, packed(color), _shortened(text, most))
    return clicked


def _picture(ui: Ui, draw: imgui.ImDrawList, state: AppState, one: Autosave, low: ImVec2, high: ImVec2) -> None:
    """The picture of the run, cut to the frame; a sign if there is none."""
    rgba = state.left_off.pictures.get(str(one.file))
    if rgba is None:
        draw.add_rect_filled(low, high, packed(ui.theme.hairline))
        sign = icons.ICON_FA_IMAGE
        extent = imgui.calc_text_size(sign)
        middle = ImVec2(int((low.x + high.x - extent.x) / 2), int((low.y + high.y - extent.y) / 2))
        draw.add_text(middle, packed(ui.theme.muted), sign)
        return
    shape = rgba.shape[1] / rgba.shape[0] * (high.y - low.y) / (high.x - low.x)  # of the picture, over the frame's
    u, v = 0.5 * max(0.0, 1 - 1 / shape), 0.5 * max(0.0, 1 - shape)
    tint = packed(ImVec4(1, 1, 1, 0.4 if one.problem else 1.0))
    texture = ui.texture(f"left_off.{one.file}", rgba)
    draw.add_image(texture, low, high, ImVec2(u, v), ImVec2(1 - u, 1 - v), tint)


def _when(saved: float) -> str:
    """ "today 14:05", "yesterday 14:05", "3 May 14:05" or, of another year, "3 May 2025"."""
    then, now = time.localtime(saved), time.localtime()
    clock, day = time.strftime("%H:%M", then), f"{then.tm_mday} {tr(MONTHS[then.tm_mon - 1])}"
    before = time.localtime(time.mktime((now.tm_year, now.tm_mon, now.tm_mday - 1, 12, 0, 0, 0, 0, -1)))
    for text, other in ((tr("today {clock}"), now), (tr("yesterday {clock}"), before)):
        if then[:3] == other[:3]:
            return text.format(clock=clock)
    return f"{day} {clock}" if then.tm_year == now.tm_year else f"{day} {then.tm_year}"


def _shortened(text: str, most: float) -> str:
    """A text that is at most `most` pixels wide: its middle is left out, because paths differ at their ends."""
    if imgui.calc_text_size(text).x <= most:
        return text
    fit, too_many = 0, len(text)
    while too_many - fit > 1:
        letters = (fit + too_many) // 2
        short = _without_middle(text, letters)
        fit, too_many = (letters, too_many) if imgui.calc_text_size(short).x <= most else (fit, letters)
    return _without_middle(text, fit)


def _without_middle(text: str, letters: int) -> str:
    head = letters // 2
    return f"{text[:head]} … {text[len(text) - (letters - head) :]}" if letters else "…"
