"""The side bar that shows a tour: prose, equations with live numbers, things to do, a question, and the way on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from imgui_bundle import ImVec2, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, tr

from ..model.state import Action, AppState
from ..ui.widgets import button, hint, packed
from .guide import Guide
from .rich_text import rich_text
from .steps import FIELD, Equation, Prose, Question, Step, Task
from .values import VALUES

if TYPE_CHECKING:
    from ..ui.contract import Ui

WIDTH_EM, MOST_SHARE = 24.0, 0.34  # of the bar, and at most this share of the window
LEAST_LETTERS = 12  # of a line: in a bar so narrow, the rest of an equation is cut off
BACK, NEXT, LEAVE = marked("Back"), marked("Next"), marked("Leave the tour")
FLAGS = (
    imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_title_bar | imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_move
)  # fmt: skip


def broken(equation: str, letters: int) -> list[str]:
    """Break a line of symbols that is longer than so many letters: before an equals sign, else at a space."""
    letters = max(letters, LEAST_LETTERS)
    lines: list[str] = []
    rest = equation
    while len(rest) > letters:
        at = max(rest.rfind(" = ", 3, letters), rest.rfind(" → ", 3, letters))
        at = at if at > letters // 3 else rest.rfind(" ", 3, letters + 1)  # from 3: behind the two spaces of a new line
        if at < 0:
            break
        lines.append(rest[:at])
        rest = f"  {rest[at:].strip()}"
    return [*lines, rest]


class SideBar:
    """The tour's part of the window. Call `draw` once a frame, before the docks."""

    def __init__(self, guide: Guide) -> None:
        self.guide = guide
        self._just_answered: tuple[str, int] | None = None  # the question whose answer comes into view
        self._shown = ""  # the step whose text begins at the top

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        guide, wish = self.guide, state.tour
        state.tour = None
        if wish is not None:
            if wish.to == "begin":
                guide.begin(state, wish.folder)
            elif guide.on:
                {"next": self._next, "back": self._back, "leave": lambda: guide.leave(state)}[wish.to]()
        yield from guide.act(state)
        state.in_tour = guide.on
        if not guide.on:
            return
        area = imgui.get_main_viewport()
        width = float(round(min(WIDTH_EM * ui.em, MOST_SHARE * area.size.x)))
        imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(ui.em, 0.8 * ui.em))
        imgui.push_style_var(imgui.StyleVar_.window_border_size, 0.0)
        begun = imgui.internal.begin_viewport_side_bar("tour", area, imgui.Dir.left, width, FLAGS)
        imgui.pop_style_var(2)
        if begun:
            self._content(ui, state)
        imgui.end()

    def _next(self) -> None:
        self.guide.go(self.guide.at + 1)

    def _back(self) -> None:
        self.guide.go(self.guide.at - 1)

    # ---- content ------------------------------------------------------------------------------------------------

    def _content(self, ui: Ui, state: AppState) -> None:
        guide, step = self.guide, self.guide.step
        if step is None:
            hint(ui, guide.error or tr("Reading the tour …"), ui.theme.error if guide.error else None)
            if button(ui, tr(LEAVE), "tour.leave"):
                guide.leave(state)
            return
        self._steps(ui)
        footer = 2 * imgui.get_frame_height_with_spacing() + 0.4 * ui.em
        imgui.begin_child("step", ImVec2(0, -footer))
        if self._shown != step.name:
            imgui.set_scroll_y(0)
            self._shown = step.name
        imgui.push_font(imgui.get_font(), round(1.35 * ui.em))
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted(step.title)
        imgui.pop_text_wrap_pos()
        imgui.pop_font()
        ui.mark("tour.title")
        task = 0
        for number, block in enumerate(step.blocks):
            imgui.dummy(ImVec2(0, 0.15 * ui.em))
            match block:
                case Prose():
                    self._prose(ui, block)
                case Equation():
                    self._equation(ui, state, block)
                case Task():
                    self._task(ui, step, task, block)
                    task += 1
                case Question():
                    self._question(ui, step, number, block)
        imgui.end_child()
        self._footer(ui, state)

    def _steps(self, ui: Ui) -> None:
        """The list of the steps, which is also where "3 of 12" stands."""
        guide = self.guide
        place = tr("{n} of {total}").format(n=figure(guide.at + 1, "d"), total=figure(len(guide.steps), "d"))
        imgui.set_next_item_width(-1)
        if imgui.begin_combo("##steps", place):
            for k, one in enumerate(guide.steps):
                done = one.tasks and all((one.name, n) in guide.ticks for n, t in enumerate(one.tasks) if t.until)
                sign = icons.ICON_FA_CHECK if done else "   "
                if imgui.selectable(f"{sign} {k + 1}  {one.title}##{k}", k == guide.at)[0]:
                    guide.go(k)
                ui.mark(f"tour.step.{k}")
            imgui.end_combo()
        ui.mark("tour.steps")
        imgui.dummy(ImVec2(0, 0.3 * ui.em))

    @staticmethod
    def _prose(ui: Ui, block: Prose) -> None:
        if block.kind == "item":
            at = imgui.get_cursor_screen_pos()
            imgui.get_window_draw_list().add_text(ImVec2(at.x + 0.3 * ui.em, at.y), packed(ui.theme.accent), "•")
            rich_text(ui, block.text, indent=1.1 * ui.em)
        else:
            rich_text(ui, block.text, ui.theme.muted if block.kind == "note" else None)

    @staticmethod
    def _equation(ui: Ui, state: AppState, block: Equation) -> None:
        """On a quiet ground, in the mono font."""
        text = FIELD.sub(lambda found: VALUES[found[1]](state), block.text)
        draw, pad = imgui.get_window_draw_list(), 0.45 * ui.em
        at, wide = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x
        imgui.push_font(ui.mono, ui.em)
        lines = broken(text, int((wide - 2 * pad) / imgui.calc_text_size("0").x))
        high = 2 * pad + len(lines) * imgui.get_text_line_height_with_spacing() - imgui.get_style().item_spacing.y
        ground = packed(imgui.get_style_color_vec4(imgui.Col_.frame_bg))
        draw.add_rect_filled(at, ImVec2(at.x + wide, at.y + high), ground, 0.2 * ui.em)
        imgui.set_cursor_screen_pos(ImVec2(at.x, at.y + pad))
        for line in lines:
            imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + pad)
            imgui.text_unformatted(line)
        imgui.pop_font()
        imgui.set_cursor_screen_pos(ImVec2(at.x, at.y + high))
        imgui.dummy(ImVec2(wide, 0.1 * ui.em))

    def _task(self, ui: Ui, step: Step, number: int, task: Task) -> None:
        done = (step.name, number) in self.guide.ticks
        sign = icons.ICON_FA_CIRCLE_CHECK if done else icons.ICON_FA_HAND_POINTER
        at = imgui.get_cursor_screen_pos()
        color = ui.theme.good if done else ui.theme.accent
        imgui.get_window_draw_list().add_text(at, packed(color), sign)
        rich_text(ui, task.text, ui.theme.muted if done else None, indent=1.6 * ui.em)
        ui.mark(f"tour.task.{number}")

    def _question(self, ui: Ui, step: Step, number: int, block: Question) -> None:
        imgui.separator()
        rich_text(ui, block.text)
        key = step.name, number
        if key in self.guide.answered:
            rich_text(ui, block.answer, ui.theme.good)
            if self._just_answered == key:  # it may lie below the visible part
                imgui.set_scroll_here_y(1.0)
                self._just_answered = None
        elif block.answer:
            imgui.push_id(number)  # a step may ask several questions
            if button(ui, f"{icons.ICON_FA_EYE}  {tr('Show the answer')}", "tour.answer"):
                self.guide.answered.add(key)
                self._just_answered = key
            imgui.pop_id()

    def _footer(self, ui: Ui, state: AppState) -> None:
        guide = self.guide
        last = guide.at + 1 == len(guide.steps)
        half = 0.5 * (imgui.get_content_region_avail().x - imgui.get_style().item_spacing.x)
        back = f"{icons.ICON_FA_ARROW_LEFT}  {tr(BACK)}"
        if button(ui, back, "tour.back", enabled=guide.at > 0, width=half, tip=tr("PageUp")):
            self._back()
        imgui.same_line()
        forward = f"{tr(NEXT)}  {icons.ICON_FA_ARROW_RIGHT}"
        if button(ui, forward, "tour.next", enabled=not last, width=half, tip=tr("PageDown")):
            self._next()
        imgui.push_style_color(imgui.Col_.button, ui.theme.surface)
        if button(ui, f"{icons.ICON_FA_XMARK}  {tr(LEAVE)}", "tour.leave", width=-1):
            guide.leave(state)
        imgui.pop_style_color()
