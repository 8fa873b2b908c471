"""Draws the registered panels in their windows, and keeps one panel's fault from the others."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence

import numpy as np
from imgui_bundle import imgui, implot

from nerf_core.live.messages import Notice

from ..draw.textures import TextureCache
from ..model.state import Action, AppState
from ..ui.contract import PANELS, Panel
from ..ui.layout import in_docks
from ..ui.theme import DarkTheme

Rect = tuple[float, float, float, float]  # left, top, right, bottom in framebuffer pixels


class PanelUi:
    """The `Ui` of ui/contract.py. widgets: where each marked widget lies in this frame."""

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
        if imgui.is_item_visible():  # what is scrolled away cannot be clicked
            low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
            self.widgets[name] = (low.x, low.y, high.x, high.y)


class PanelHost:
    def __init__(self, panels: Sequence[Panel] | None = None) -> None:
        found = [PANELS.get(name)() for name in PANELS.names()] if panels is None else list(panels)
        self.panels = sorted(found, key=lambda panel: panel.order)
        self.notices: list[Notice] = []  # faults that nobody has been told of
        self.in_front: tuple[str, ...] = ()  # the panels that were not behind another's tab when they were last drawn
        self._broken: dict[str, str] = {}
        self._docked: set[str] = set()  # over the cleared framebuffer, which has the panels' colour already

    def draw(self, ui: PanelUi, state: AppState) -> Iterator[Action]:
        """The panels that have a window."""
        in_front: list[str] = []
        for panel in self.panels:
            if panel.dock == "overlay":
                continue
            flags = imgui.WindowFlags_.no_background if panel.title in self._docked else imgui.WindowFlags_.none
            if imgui.begin(panel.title, None, flags)[0]:  # False for a tab that lies behind another
                in_front.append(panel.title)
                (self._docked.add if in_docks() else self._docked.discard)(panel.title)
                if panel.title in self._broken:
                    self._draw_broken(ui, panel.title)
                else:
                    yield from self._draw_panel(panel, ui, state)
            imgui.end()
        self.in_front = tuple(in_front)

    def draw_overlays(self, ui: PanelUi, state: AppState) -> Iterator[Action]:
        """Those that open what they need themselves; a broken one stays away."""
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
            self._broken[panel.title] = f"{type(error).__name__}: {error}"
            text = f"the panel {panel.title} failed ({type(error).__name__}: {error}); the others go on"
            self.notices.append(Notice("error", text, detail=traceback.format_exc()))
            return []

    def _draw_broken(self, ui: PanelUi, title: str) -> None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(ui.theme.error, f"This panel failed: {self._broken[title]}")
        imgui.pop_text_wrap_pos()
        if imgui.button("Try again"):
            del self._broken[title]
        ui.mark(f"{title}.retry")


def _recover(before: imgui.internal.ErrorRecoveryState, theme: DarkTheme) -> None:
    """Close what the panel left open, so that the frame can go on."""
    io = imgui.get_io()
    asserts, io.config_error_recovery_enable_assert = io.config_error_recovery_enable_assert, False
    imgui.internal.error_recovery_try_to_recover_state(before)
    io.config_error_recovery_enable_assert = asserts
    implot.destroy_context()  # it has no such recovery: a plot that was left open would spoil every later one
    implot.create_context()
    theme.apply_to_plots()
