"""The help: what mouse and keys do, in the middle of the window."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import marked, tr

from ..commands.overview import overview
from ..commands.registry import Section
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Ui
from ..ui.widgets import button, keep_in_front, mono

Rows = tuple[Section, list[tuple[str, str]]]
HEADING = 1.5  # lines for a section's name and the gap after it
WHAT_EM = 12.0  # least width of the column that says what is done
WIDE_EM = 52.0  # the least width of a window with two columns
FLAGS = (
    imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_collapse
)  # fmt: skip


@PANELS.register("help")
class HelpOverlay:
    title = marked("Help")
    dock: Literal["overlay"] = "overlay"
    order = 1

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        if not state.show_help:
            return
        screen = imgui.get_main_viewport()
        imgui.set_next_window_pos(screen.get_center(), imgui.Cond_.always, ImVec2(0.5, 0.5))
        imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(0.95 * screen.size.x, 0.95 * screen.size.y))
        imgui.begin("Help##help", None, FLAGS)
        keep_in_front()
        sections = overview()
        longest = max(imgui.calc_text_size(tr(what)).x for _, rows in sections for what, _ in rows)
        wide = max(WHAT_EM * ui.em, longest + ui.em)
        columns = _columns(sections) if screen.size.x > WIDE_EM * ui.em else (sections,)
        for k, column in enumerate(columns):
            if k:
                imgui.same_line(0, 2 * ui.em)
            imgui.begin_group()
            for section, rows in column:
                _section(ui, section, rows, wide)
            imgui.end_group()
        if button(ui, tr("Close"), "help.close"):
            state.show_help = False
        imgui.end()
        yield from ()


def _columns(sections: list[Rows]) -> tuple[list[Rows], list[Rows]]:
    """The sections in order, split into two columns so that the longer one is as short as possible."""

    def height(part: list[Rows]) -> float:
        return sum(len(rows) + HEADING for _, rows in part)

    at = min(range(1, len(sections) + 1), key=lambda k: max(height(sections[:k]), height(sections[k:])))
    return sections[:at], sections[at:]


def _section(ui: Ui, section: str, rows: list[tuple[str, str]], wide: float) -> None:
    imgui.text_colored(ui.theme.accent, tr(section))
    for what, how in rows:
        imgui.text_colored(ui.theme.muted, tr(what))
        imgui.same_line(wide)
        with mono(ui):
            imgui.text_unformatted(tr(how))
    imgui.dummy(ImVec2(0, 0.3 * ui.em))
