"""Draw the registered panels in their windows. An error in one panel does not affect the others."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence

import numpy as np
from imgui_bundle import imgui, implot

from nerf_core.common.language import phrase, tr
from nerf_core.live.messages import Notice

from ..draw.textures import TextureCache
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Panel
from ..ui.layout import in_docks, window_name
from ..ui.theme import DarkTheme

Rect = tuple[float, float, float, float]  # left, top, right, bottom in framebuffer pixels


class PanelUi:
    """The `Ui` of ui/contract.py. widgets: the rectangle of each marked widget in this frame."""

    def __init__(self, theme: DarkTheme, textures: TextureCache) -> None:
        self.theme = theme
        self._textures = textures
        self.widgets: dict[str, Rect] = {}

    @property
    def em(self) -> float:
        return self.theme.em

    @property
    def mono(self) -> imgui.ImFont:
        return self.theme.mono

    def texture(self, key: str, rgba: np.ndarray, smooth: bool = True) -> imgui.ImTextureRef:
        return self._textures.get(key, rgba, smooth)

    def mark(self, name: str) -> None:
        if imgui.is_item_visible():  # a widget that is scrolled away cannot be clicked
            low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
            self.widgets[name] = (low.x, low.y, high.x, high.y)


class PanelHost:
    def __init__(self, panels: Sequence[Panel] | None = None) -> None:
        found = [PANELS.get(name)() for name in PANELS.names()] if panels is None else list(panels)
        self.panels = sorted(found, key=lambda panel: panel.order)
        self.notices: list[Notice] = []  # errors that have not been shown yet
        self.in_front: tuple[str, ...] = ()  # the panels that were not behind another's tab in the last frame
        self._broken: dict[str, str] = {}
        self._docked: set[str] = set()  # panels over the cleared framebuffer, which already has the panels' colour

    def draw(self, ui: PanelUi, state: AppState) -> Iterator[Action]:
        """Draw the panels that have a window."""
        in_front: list[str] = []
        for panel in self.panels:
            if panel.dock == "overlay" or (state.only_panels is not None and panel.title not in state.only_panels):
                continue
            flags = imgui.WindowFlags_.no_background if panel.title in self._docked else imgui.WindowFlags_.none
            if imgui.begin(window_name(panel.title), None, flags)[0]:  # False for a tab behind another
                in_front.append(panel.title)
                (self._docked.add if in_docks() else self._docked.discard)(panel.title)
                if panel.title in self._broken:
                    self._draw_broken(ui, panel.title)
                else:
                    yield from self._draw_panel(panel, ui, state)
            imgui.end()
        self.in_front = tuple(in_front)

    def draw_page(self, ui: PanelUi, state: AppState) -> Iterator[Action]:
        """Draw one panel alone, between the bars."""
        area = imgui.get_main_viewport()
        imgui.set_next_window_pos(area.work_pos)
        imgui.set_next_window_size(area.work_size)
        flags = imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_saved_settings
        flags &= ~imgui.WindowFlags_.no_scrollbar
        for panel in self.panels:
            if panel.title != state.page:
                continue
            imgui.push_style_var(imgui.StyleVar_.window_border_size, 0.0)
            begun = imgui.begin(f"{panel.title}##page", None, flags | imgui.WindowFlags_.no_bring_to_front_on_focus)[0]
            imgui.pop_style_var()
            if begun:
                if panel.title in self._broken:
                    self._draw_broken(ui, panel.title)
                else:
                    yield from self._draw_panel(panel, ui, state)
            imgui.end()

    def draw_overlays(self, ui: PanelUi, state: AppState) -> Iterator[Action]:
        """Draw the overlays, which open their own windows. A broken one is not drawn again."""
        for panel in self.panels:
            if panel.dock == "overlay" and panel.title not in self._broken:
                yield from self._draw_panel(panel, ui, state)

    def _draw_panel(self, panel: Panel, ui: PanelUi, state: AppState) -> list[Action]:
        before = imgui.internal.ErrorRecoveryState()
        imgui.internal.error_recovery_store_state(before)
        try:
            return list(panel.draw(ui, state))
        except Exception as error:
            _recover(before, ui.theme)
            what = self._broken[panel.title] = f"{type(error).__name__}: {error}"
            words = phrase(
                "the panel {title} failed ({error}); the others go on", title=phrase(panel.title), error=what
            )
            self.notices.append(Notice("error", words, detail=traceback.format_exc()))
            return []

    def _draw_broken(self, ui: PanelUi, title: str) -> None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(ui.theme.error, tr("This panel failed: {error}").format(error=self._broken[title]))
        imgui.pop_text_wrap_pos()
        if imgui.button(f"{tr('Try again')}##retry"):
            del self._broken[title]
        ui.mark(f"{title}.retry")


def _recover(before: imgui.internal.ErrorRecoveryState, theme: DarkTheme) -> None:
    """Close what a panel left open, so that the frame can go on."""
    io = imgui.get_io()
    asserts, io.config_error_recovery_enable_assert = io.config_error_recovery_enable_assert, False
    imgui.internal.error_recovery_try_to_recover_state(before)
    io.config_error_recovery_enable_assert = asserts
    implot.destroy_context()  # implot cannot recover: an open plot would spoil all later ones
    implot.create_context()
    theme.apply_to_plots()
