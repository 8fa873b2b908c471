"""The notices panel: files written, warnings and errors, newest first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from nerf_core.common.language import marked, tr
from nerf_core.common.text import duration

from ..model.state import Action, AppState, ShownNotice
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, hint, mono, notice_text, path_line


@PANELS.register("notices")
class NoticesPanel:
    title = marked("Notices")
    dock: Literal["right"] = "right"
    order = 4

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if not state.notices:
            hint(ui, tr("Nothing has happened yet: files that were written, warnings and errors will be listed here."))
        for index in reversed(range(len(state.notices))):
            imgui.push_id(index)
            _entry(ui, state.notices[index], state.time, f"notices.{index}")
            imgui.pop_id()
        yield from ()


def _entry(ui: Ui, shown: ShownNotice, now: float, mark: str) -> None:
    notice = shown.notice
    shown.dismissed |= imgui.is_window_focused()  # a notice read here is not shown over the picture as well
    notice_text(ui, notice)
    hint(ui, tr("{time} ago").format(time=tr(duration(now - shown.born))))
    if notice.path is not None:
        path_line(ui, notice.path, f"{mark}.copy")
    if notice.detail:
        opened = imgui.tree_node(f"{tr('details')}###details")
        ui.mark(f"{mark}.details")
        if opened:
            if button(ui, f"{icons.ICON_FA_COPY}  {tr('Copy')}", f"{mark}.copy_details"):
                imgui.set_clipboard_text(notice.detail)
            with mono(ui):
                imgui.text_unformatted(notice.detail)
            imgui.tree_pop()
    imgui.separator()
