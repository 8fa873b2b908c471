"""Inject mouse and keyboard input into imgui, one event per frame, for tests and scripts."""

from __future__ import annotations

from collections.abc import Callable

from imgui_bundle import imgui


class InputInjector:
    """Press keys and move the mouse like a user.

    frame: draws one frame; called after each event. Positions are framebuffer pixels from the window's top left.
    """

    def __init__(self, frame: Callable[[], object]) -> None:
        self._frame = frame

    def move(self, x: float, y: float) -> None:
        imgui.get_io().add_mouse_pos_event(x, y)
        self._frame()

    def press(self, button: int = 0) -> None:
        imgui.get_io().add_mouse_button_event(button, True)
        self._frame()

    def release(self, button: int = 0) -> None:
        imgui.get_io().add_mouse_button_event(button, False)
        self._frame()

    def click(self, x: float, y: float, button: int = 0) -> None:
        self.move(x, y)
        self.press(button)
        self.release(button)
        self._frame()  # draws what the click changed

    def double_click(self, x: float, y: float) -> None:
        self.click(x, y)
        self.click(x, y)

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], button: int = 0, steps: int = 4, shift: bool = False
    ) -> None:
        """Drag from one point to another in `steps` moves."""
        self.move(*start)
        if shift:
            self._key(imgui.Key.mod_shift, True)
        self.press(button)
        for k in range(1, steps + 1):
            share = k / steps
            self.move(*(a + share * (b - a) for a, b in zip(start, end, strict=True)))
        self.release(button)
        if shift:
            self._key(imgui.Key.mod_shift, False)

    def wheel(self, x: float, y: float, steps: float) -> None:
        self.move(x, y)
        imgui.get_io().add_mouse_wheel_event(0.0, steps)
        self._frame()

    def key(self, key: imgui.Key, *, ctrl: bool = False) -> None:
        if ctrl:
            self._key(imgui.Key.mod_ctrl, True)
        self._key(key, True)
        self._key(key, False)
        if ctrl:
            self._key(imgui.Key.mod_ctrl, False)

    def hold(self, key: imgui.Key, frames: int) -> None:
        self._key(key, True)
        for _ in range(frames):
            self._frame()
        self._key(key, False)

    def type_text(self, text: str) -> None:
        for letter in text:
            imgui.get_io().add_input_character(ord(letter))
            self._frame()

    def _key(self, key: imgui.Key, down: bool) -> None:
        imgui.get_io().add_key_event(key, down)
        self._frame()
