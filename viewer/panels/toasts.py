"""Toasts over a corner of the picture: errors and results, for as long as it takes to read them.

The notices panel keeps them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import marked, tr

from ..model.state import Action, AppState, ShownNotice
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, keep_in_front, notice_text, path_line

MOST = 3  # the panel lists the others
WIDTH_EM = 26.0
FLAGS = (
    imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_focus_on_appearing | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_move
)  # fmt: skip


@PANELS.register("toasts")
class Toasts:
    title = marked("Toasts")
    dock: Literal["overlay"] = "overlay"
    order = 0

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        shown = [(i, n) for i, n in enumerate(state.notices) if not n.dismissed and state.time < n.ends][-MOST:]
        if not shown or state.viewport_rect is None:
            return
        x, y, width, height = state.viewport_rect
        gap = 0.8 * ui.em
        inner = min(WIDTH_EM * ui.em, width - 4 * gap)
        if inner < 6 * ui.em:
            return  # the picture is too small; the notices panel and the status bar show them
        imgui.set_next_window_pos(ImVec2(x + width - gap, y + height - gap), imgui.Cond_.always, ImVec2(1, 1))
        imgui.set_next_window_size_constraints(ImVec2(inner, 0), ImVec2(inner, max(height - 2 * gap, gap)))
        imgui.begin("##toasts", None, FLAGS)
        keep_in_front()
        for place, (index, notice) in enumerate(shown):
            if place:
                imgui.separator()
            imgui.push_id(index)
            _toast(ui, notice, f"toasts.{index}")
            imgui.pop_id()
        imgui.end()
        yield from ()


def _toast(ui: Ui, shown: ShownNotice, mark: str) -> None:
    if button(ui, icons.ICON_FA_XMARK, f"{mark}.dismiss", tip=tr("dismiss; Notices keeps it")):
        shown.dismissed = True
    imgui.same_line()
    notice_text(ui, shown.notice)
    if shown.notice.path is not None:
        path_line(ui, shown.notice.path, f"{mark}.copy")
