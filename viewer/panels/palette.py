"""The command palette: type a part of a command's name, choose it with the arrow keys, run it with Enter."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import marked, tr

from ..commands.registry import UserCommand, commands, invoke
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import faded, hint, mono

ITSELF = "show.palette"
POPUP = "palette"
WIDTH_EM, TITLE_EM = 30.0, 7.0  # of the palette; least width of its column with the sections
TOP = 0.12  # of the window's height
MOST_ROWS = 14


@PANELS.register("palette")
class Palette:
    title = marked("Commands")
    dock: Literal["overlay"] = "overlay"
    order = 2

    def __init__(self) -> None:
        self._open = False
        self._focus = False  # give the field the keyboard focus
        self._query = ""
        self._chosen = 0  # index among the commands that match

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if not state.show_palette:
            self._open = False
            return
        if not self._open:
            self._open, self._focus, self._query, self._chosen = True, True, "", 0
            imgui.open_popup(POPUP)
        screen = imgui.get_main_viewport()
        width = min(WIDTH_EM * ui.em, 0.9 * screen.size.x)
        place = ImVec2(screen.get_center().x, screen.pos.y + TOP * screen.size.y)
        imgui.set_next_window_pos(place, imgui.Cond_.always, ImVec2(0.5, 0.0))
        imgui.set_next_window_size(ImVec2(width, 0))
        if not imgui.begin_popup(POPUP):  # a click outside has closed it
            state.show_palette = False
            return
        command = self._content(ui, state)
        if command is not None or imgui.is_key_pressed(imgui.Key.escape, False):
            imgui.close_current_popup()
            state.show_palette = False
        imgui.end_popup()
        if command is not None:
            yield from invoke(command, state)

    def _content(self, ui: Ui, state: AppState) -> UserCommand | None:
        """Draw the field and the list. Returns the command to run, else None."""
        if self._focus:
            imgui.set_keyboard_focus_here()
            self._focus = False
        imgui.set_next_item_width(-1)
        changed, self._query = imgui.input_text_with_hint("##query", tr("type a command"), self._query)
        ui.mark("palette.query")
        found = matching(self._query)
        if not found:
            hint(ui, tr("No command has this in its name."))
            return None
        step = int(imgui.is_key_pressed(imgui.Key.down_arrow)) - int(imgui.is_key_pressed(imgui.Key.up_arrow))
        self._chosen = 0 if changed else (self._chosen + step) % len(found)
        clicked = self._list(ui, state, found, follow=bool(step or changed))
        if clicked is not None:
            return clicked
        entered = any(imgui.is_key_pressed(key, False) for key in (imgui.Key.enter, imgui.Key.keypad_enter))
        if not entered:
            return None
        if found[self._chosen].enabled(state):
            return found[self._chosen]
        self._focus = True  # Enter has taken the focus from the field
        return None

    def _list(self, ui: Ui, state: AppState, found: list[UserCommand], follow: bool) -> UserCommand | None:
        """Draw one line per command. Returns the one that was clicked. follow: scroll to the chosen one."""
        row = imgui.get_text_line_height_with_spacing()
        room = int((1 - TOP) * imgui.get_main_viewport().size.y / row) - 4  # minus the field and the status bar
        imgui.begin_child("list", ImVec2(0, max(min(len(found), MOST_ROWS, room), 1) * row))
        imgui.push_style_color(imgui.Col_.header, faded(ui.theme.accent, 0.3))
        clicked, names = None, [tr(command.section) for command in commands()]
        wide = max(TITLE_EM * ui.em, max(imgui.calc_text_size(name).x for name in names) + ui.em)
        for k, command in enumerate(found):
            imgui.begin_disabled(not command.enabled(state))
            if imgui.selectable(f"##{command.id}", k == self._chosen)[0]:
                clicked = command
            ui.mark(f"palette.{command.id}")
            if follow and k == self._chosen:
                imgui.set_scroll_here_y(0.5)
            _line(ui, state, command, wide)
            imgui.end_disabled()
        imgui.pop_style_color()
        imgui.end_child()
        return clicked


def _line(ui: Ui, state: AppState, command: UserCommand, wide: float) -> None:
    """Draw section, title and, on the right, keys over the last item. wide: the column with the sections."""
    imgui.same_line(0.3 * ui.em)
    imgui.text_colored(ui.theme.muted, tr(command.section))
    imgui.same_line(wide)
    imgui.text_unformatted(tr(command.title))
    if command.checked is not None:
        imgui.same_line(0, 0.5 * ui.em)
        imgui.text_colored(ui.theme.muted, tr("shown") if command.checked(state) else tr("hidden"))
    if command.keys:
        with mono(ui):
            keys = ", ".join(command.keys)
            imgui.same_line(imgui.get_window_width() - imgui.calc_text_size(keys).x - 0.9 * ui.em)
            imgui.text_colored(ui.theme.muted, keys)


def matching(query: str) -> list[UserCommand]:
    """Return the commands whose section and title contain every word of `query`, in English or as they are shown.

    Those whose title begins with the first word come first.
    """
    words = query.casefold().split()

    def names(command: UserCommand) -> str:
        return f"{tr(command.section)} {tr(command.title)} {command.section} {command.title}".casefold()

    def later(command: UserCommand) -> bool:
        return bool(words) and not any(
            title.casefold().startswith(words[0]) for title in (command.title, tr(command.title))
        )

    found = [c for c in commands() if c.id != ITSELF and all(word in names(c) for word in words)]
    return sorted(found, key=later)
