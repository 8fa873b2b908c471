"""A screen without GL, on which one panel is drawn and clicked."""

from __future__ import annotations

import numpy as np
from imgui_bundle import ImVec2, imgui

from viewer.model.state import Action, AppState
from viewer.ui.contract import Panel
from viewer.ui.layout import window_name
from viewer.ui.theme import DarkTheme

SCREEN = (1280, 800)


class Screen:
    """A `Ui` (viewer/ui/contract.py) for one panel, with the real theme and fonts. Textures are not uploaded."""

    def __init__(self) -> None:
        self.theme = DarkTheme()
        self.theme.load_fonts()
        self.theme.apply(1.0)
        self.widgets: dict[str, tuple[float, float, float, float]] = {}
        self.pictures: dict[str, np.ndarray] = {}
        self.size = (420.0, 700.0)

    @property
    def em(self) -> float:
        return self.theme.em

    @property
    def mono(self) -> imgui.ImFont:
        return self.theme.mono

    def texture(self, key: str, rgba: np.ndarray, smooth: bool = True) -> imgui.ImTextureRef:
        assert rgba.dtype == np.uint8
        assert rgba.ndim == 3
        assert rgba.shape[2] == 4
        self.pictures[key] = rgba
        return imgui.ImTextureRef(7)

    def mark(self, name: str) -> None:
        low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
        self.widgets[name] = (low.x, low.y, high.x, high.y)

    def frame(self, panel: Panel, state: AppState) -> list[Action]:
        self.widgets.clear()
        imgui.new_frame()
        imgui.set_next_window_pos(ImVec2(10, 10))
        imgui.set_next_window_size(ImVec2(*self.size))
        actions: list[Action] = []
        if panel.dock == "overlay":
            actions += panel.draw(self, state)
        else:
            imgui.begin(window_name(panel.title))
            actions += panel.draw(self, state)
            imgui.end()
        imgui.render()
        return actions

    def click(self, panel: Panel, state: AppState, name: str, button: int = 0) -> list[Action]:
        self.frame(panel, state)
        self.frame(panel, state)
        left, top, right, bottom = self.widgets[name]
        return self.drag(panel, state, ((left + right) / 2, (top + bottom) / 2), button=button)

    def type(self, panel: Panel, state: AppState, name: str, text: str) -> None:
        """Type a number into a field that can be dragged. A click with Ctrl edits it."""
        io = imgui.get_io()
        io.add_key_event(imgui.Key.mod_ctrl, True)
        self.click(panel, state, name)
        io.add_key_event(imgui.Key.mod_ctrl, False)
        self.frame(panel, state)
        io.add_input_characters_utf8(text)
        self.frame(panel, state)
        for down in (True, False):
            io.add_key_event(imgui.Key.enter, down)
            self.frame(panel, state)

    def drag(self, panel: Panel, state: AppState, *places: tuple[float, float], button: int = 0) -> list[Action]:
        """Press at the first place, move through the others, release at the last."""
        io, actions = imgui.get_io(), []
        io.add_mouse_pos_event(*places[0])
        actions += self.frame(panel, state)
        io.add_mouse_button_event(button, True)
        actions += self.frame(panel, state)
        for place in places[1:]:
            io.add_mouse_pos_event(*place)
            actions += self.frame(panel, state)
        io.add_mouse_button_event(button, False)
        return actions + self.frame(panel, state) + self.frame(panel, state)
