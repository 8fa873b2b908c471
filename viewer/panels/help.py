"""What mouse and keys do, over the middle of the window while it is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from imgui_bundle import ImVec2, imgui

from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, keep_in_front, mono

HANDS = (
    ("orbit", "drag"),
    ("pan", "right drag, Shift+drag"),
    ("zoom", "wheel, towards the pointer"),
    ("fly", "W A S D"),
    ("fly down, up", "Q, E"),
    ("fly faster", "Shift"),
    ("inspect a ray", "click"),
    ("pin a ray", "Ctrl+click"),
    ("close the ray", "Esc"),
    ("focus on a point", "double click"),
    ("", ""),
    ("colour, view-dependence", "1, 2"),
    ("frame the scene", "F"),
    ("reset the view", "R"),
    ("next, previous training photo", "→, ←"),
    ("train or pause", "Space"),
    ("one training step", "."),
    ("", ""),
    ("open a scene", "Ctrl+O"),
    ("save a checkpoint", "Ctrl+S"),
    ("export an orbit", "Ctrl+E"),
    ("hide or show the panels", "Tab"),
    ("this help", "H"),
    ("", ""),
    ("plots: fit", "double click"),
    ("plots: move, zoom", "drag, wheel"),
    ("move the radiance point", "drag its line in the ray panel"),
)
FLAGS = (
    imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_collapse
)  # fmt: skip


@PANELS.register("help")
class HelpOverlay:
    title = "Keys"
    dock: Literal["overlay"] = "overlay"
    order = 1

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if not state.show_help:
            return
        screen = imgui.get_main_viewport()
        imgui.set_next_window_pos(screen.get_center(), imgui.Cond_.always, ImVec2(0.5, 0.5))
        imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(0.95 * screen.size.x, 0.95 * screen.size.y))
        imgui.begin("Keys##help", None, FLAGS)
        keep_in_front()
        if imgui.begin_table("keys", 2, imgui.TableFlags_.sizing_fixed_fit):
            for what, how in HANDS:
                imgui.table_next_row()
                imgui.table_next_column()
                imgui.text_colored(ui.theme.muted, what)
                imgui.table_next_column()
                with mono(ui):
                    imgui.text_unformatted(how)
            imgui.end_table()
        if button(ui, "Close", "help.close"):
            state.show_help = False
        imgui.end()
        yield from ()
