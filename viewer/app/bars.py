"""The menu bar at the top and the status bar at the bottom."""

from __future__ import annotations

from collections.abc import Iterator

from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.language import figure, marked, tr, trn
from nerf_core.common.text import duration, rate
from nerf_core.live.messages import Reset

from ..commands.actions.files import saved_first
from ..commands.registry import MENUS, SUBMENUS, USER_COMMANDS, Menu, UserCommand, commands, invoke, run, with_keys
from ..model.state import Action, AppState, nothing_to_train_in
from ..ui.theme import CLEAR
from .panel_host import PanelUi

STATES = {
    "empty": marked("nothing is open"), "loading": marked("loading"), "ready": marked("ready"),
    "training": marked("training"), "paused": marked("paused"), "finished": marked("finished"),
    "failed": marked("failed"),
}  # fmt: skip  # of a run

# ---- above --------------------------------------------------------------------------------------------------------


def draw_menu(ui: PanelUi, state: AppState) -> Iterator[Action]:
    imgui.push_style_var(imgui.StyleVar_.window_border_size, 0.0)  # a border would reach into the viewport's first row
    begun = imgui.begin_main_menu_bar()
    imgui.pop_style_var()
    if not begun:
        return
    for menu in MENUS:
        if imgui.begin_menu(f"{tr(menu)}###{menu}"):
            yield from _menu(ui, state, menu)
            yield from _submenus(ui, state, menu)
            imgui.end_menu()
    yield from _training(ui, state)
    imgui.end_main_menu_bar()


def _menu(ui: PanelUi, state: AppState, menu: Menu) -> Iterator[Action]:
    listed = [command for command in commands() if command.menu == menu]
    for before, command in zip([None, *listed], listed, strict=False):
        if before is not None and before.section != command.section:
            imgui.separator()
        yield from _item(ui, state, command)


def _submenus(ui: PanelUi, state: AppState, menu: Menu) -> Iterator[Action]:
    for below, above in SUBMENUS.items():
        if above != menu:
            continue
        imgui.separator()
        opened = imgui.begin_menu(f"{tr(below)}###{below}")
        ui.mark(f"submenu.{below}")
        if opened:
            yield from _menu(ui, state, below)
            imgui.end_menu()


def _item(ui: PanelUi, state: AppState, command: UserCommand) -> Iterator[Action]:
    holds = command.checked or command.chosen
    checked = holds is not None and holds(state)
    shown = ", ".join(command.keys)
    pressed, _ = imgui.menu_item(f"{tr(command.title)}###{command.id}", shown, checked, command.enabled(state))
    ui.mark(f"menu.{command.title}")
    if pressed:
        yield from invoke(command, state)


def _training(ui: PanelUi, state: AppState) -> Iterator[Action]:
    snapshot = state.snapshot
    training, untrainable = snapshot.status == "training", tr(nothing_to_train_in(snapshot))
    imgui.dummy(ImVec2(0.5 * ui.em, 0))
    if snapshot.method:
        imgui.text_colored(ui.theme.muted, snapshot.method)
        imgui.dummy(ImVec2(0.2 * ui.em, 0))
    imgui.begin_disabled(snapshot.scene is None or bool(untrainable))
    label = f"{icons.ICON_FA_PAUSE}  {tr('Pause')}" if training else f"{icons.ICON_FA_PLAY}  {tr('Train')}"
    imgui.push_style_color(imgui.Col_.button, CLEAR)
    imgui.push_style_color(imgui.Col_.text, ui.theme.text if training else ui.theme.accent)
    pressed = imgui.button(f"{label}###bar.train")
    imgui.pop_style_color()
    ui.mark("bar.train")
    _tip(untrainable or ", ".join(USER_COMMANDS.get("training.toggle").keys))
    if pressed:
        yield from run("training.toggle", state)
    stepped = imgui.button(f"{icons.ICON_FA_FORWARD_STEP}###bar.step")
    ui.mark("bar.step")
    _tip(untrainable or with_keys(tr("one training step"), "training.step"))
    if stepped:
        yield from run("training.step", state)
    if imgui.button(f"{icons.ICON_FA_ROTATE_LEFT}###bar.reset"):
        imgui.open_popup("forget")
    ui.mark("bar.reset")
    _tip(untrainable or tr("start training again"))
    imgui.pop_style_color()
    imgui.end_disabled()
    if imgui.begin_popup("forget"):
        imgui.text(
            trn("Starting again forgets {n} trained step.", "Starting again forgets {n} trained steps.", snapshot.step)
        )
        if imgui.button(tr("Save and start again")):
            imgui.close_current_popup()
            yield saved_first(state, Reset())
        ui.mark("bar.reset_save")
        imgui.same_line()
        if imgui.button(tr("Forget and start again")):
            imgui.close_current_popup()
            yield Reset()
        ui.mark("bar.reset_confirm")
        imgui.same_line()
        if imgui.button(tr("Keep")):
            imgui.close_current_popup()
        imgui.end_popup()


def _tip(text: str) -> None:
    """Show a tooltip of the last item, also while it is disabled."""
    if imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled | imgui.HoveredFlags_.for_tooltip):
        imgui.set_tooltip(text)


# ---- below --------------------------------------------------------------------------------------------------------


def draw_status(ui: PanelUi, state: AppState) -> None:
    flags = imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_saved_settings
    flags |= imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_docking
    imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(0.75 * ui.em, 0.25 * ui.em))
    imgui.push_style_var(imgui.StyleVar_.window_border_size, 0.0)
    height = float(round(1.6 * ui.em))
    begun = imgui.internal.begin_viewport_side_bar("status", imgui.get_main_viewport(), imgui.Dir.down, height, flags)
    imgui.pop_style_var(2)
    if begun:
        snapshot = state.snapshot
        imgui.push_font(ui.mono, ui.em)
        for k, (words, color) in enumerate(_figures(ui, state)):
            if k:
                imgui.same_line(0, 0.5 * ui.em)
                imgui.text_colored(ui.theme.muted, "·")
                imgui.same_line(0, 0.5 * ui.em)
            imgui.text_colored(color, words)
        if snapshot.preview is not None and snapshot.preview.caption:
            _caption(ui, tr(snapshot.preview.caption))
        imgui.pop_font()
    imgui.end()


def _caption(ui: PanelUi, text: str) -> None:
    """What the picture shows, in the method's words, at the right end. It is cut short where there is no room."""
    imgui.same_line(0, 1.5 * ui.em)
    room, width = imgui.get_content_region_avail().x, imgui.calc_text_size(text).x
    shown, kept = text, len(text)
    while kept and imgui.calc_text_size(shown).x > room:
        kept = min(kept - 1, int(len(text) * room / width))  # most letters are equally wide
        shown = f"{text[:kept].rstrip()}…" if kept > 0 else ""
    if not shown:
        return
    imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + max(room - width, 0.0))
    imgui.text_colored(ui.theme.text, shown)
    ui.mark("status.caption")
    if shown != text:
        imgui.set_item_tooltip(text)


def _figures(ui: PanelUi, state: AppState) -> list[tuple[str, ImVec4]]:
    """The texts of the status bar from left to right. Unknown figures are left out."""
    snapshot, theme = state.snapshot, ui.theme
    found: list[tuple[str, ImVec4]] = []
    untrainable = snapshot.status == "finished" and nothing_to_train_in(snapshot)
    if snapshot.scene is not None and not untrainable:
        found.append((tr("step {step}").format(step=figure(snapshot.step, ",")), theme.text))
    if len(snapshot.history.psnr):
        found.append((f"{figure(float(snapshot.history.psnr[-1]), '.1f')} {tr('dB')}", theme.text))
    if snapshot.status == "training":
        if snapshot.rays_per_second:
            found.append((tr("{rate} rays/s").format(rate=tr(rate(snapshot.rays_per_second))), theme.text))
        if snapshot.seconds_left is not None:
            found.append((tr("{time} left").format(time=tr(duration(snapshot.seconds_left))), theme.text))
    elif snapshot.status == "failed":
        found.append((tr("failed"), theme.error))
    else:
        words = tr("nothing to train") if untrainable else tr(STATES[snapshot.status])
        if snapshot.status == "empty" and state.unposed is not None:
            words = tr("no poses were found: nothing is open")
        found.append((tr(snapshot.loading) or words, theme.muted))
    if snapshot.memory_bytes:
        found.append((tr("{n} MB").format(n=figure(snapshot.memory_bytes / 2**20, ",.0f")), theme.muted))
    if snapshot.device:
        found.append((tr(snapshot.device), theme.muted))
    found.append((tr("{n} fps").format(n=figure(state.frames_per_second, ".0f")), theme.muted))
    return found
