"""Keyboard input: run the commands whose keys are pressed, and fly the camera while keys are held."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from ..model.state import Action, AppState
from .registry import UserCommand, commands, invoke

NAMED = {
    "Space": "space", "Tab": "tab", "Esc": "escape", "Enter": "enter", "Backspace": "backspace", "Delete": "delete",
    "Home": "home", "End": "end", "PageUp": "page_up", "PageDown": "page_down", "→": "right_arrow", "←": "left_arrow",
    "↑": "up_arrow", "↓": "down_arrow", ".": "period", ",": "comma", "-": "minus", "=": "equal",
}  # fmt: skip
FLY = (("D", "A"), ("E", "Q"), ("W", "S"))  # right and left, up and down, forward and back
CTRL = "Ctrl+"


@dataclass(frozen=True)
class Chord:
    key: imgui.Key
    ctrl: bool

    @staticmethod
    def parse(text: str) -> Chord:
        """ "Ctrl+S" → Chord(Key.s, True). Raises ValueError for a key that has no name here."""
        name = text.removeprefix(CTRL)
        if name in NAMED:
            ours = NAMED[name]
        elif len(name) == 1 and name.isascii() and name.isalnum():
            ours = f"_{name}" if name.isdigit() else name.lower()
        elif name[:1] == "F" and name[1:].isdigit():
            ours = name.lower()
        else:
            ours = ""
        if not hasattr(imgui.Key, ours or "?"):
            raise ValueError(f"no key is called {name!r}: take a letter, a digit, F1 to F24, or {' '.join(NAMED)}")
        return Chord(getattr(imgui.Key, ours), text.startswith(CTRL))


class Keyboard:
    """Call `act` once a frame, before anything is drawn."""

    def __init__(self) -> None:
        self._chords = [(Chord.parse(text), command) for command in commands() for text in command.keys]
        self._ctrl = False  # whether Ctrl was down in the last frame

    def act(self, state: AppState, seconds: float) -> tuple[list[Action], bool]:
        """Return the actions of the pressed keys, and whether a key is held that moves the camera.

        While a text field has the focus, no key counts here. seconds: since the last frame.
        """
        io = imgui.get_io()
        if io.want_text_input or state.show_palette:
            return [], False
        # imgui would use Tab to step through the fields of the last window; here Tab hides the panels.
        imgui.internal.set_key_owner(imgui.Key.tab, imgui.get_id("tab hides the panels"))
        # In a slow frame Ctrl may be released in the same frame in which its letter is pressed.
        before, self._ctrl = self._ctrl, io.key_ctrl or io.key_super
        ctrl = self._ctrl or before
        if not ctrl and imgui.is_key_pressed(imgui.Key.escape, False) and _close_what_is_over(state):
            return [], False
        actions = [action for command in self._asked(state, ctrl) for action in invoke(command, state)]
        return actions, not ctrl and _fly(state, seconds)

    def _asked(self, state: AppState, ctrl: bool) -> list[UserCommand]:
        return [
            command
            for chord, command in self._chords
            if chord.ctrl == ctrl and imgui.is_key_pressed(chord.key, command.repeat) and command.enabled(state)
        ]


def _close_what_is_over(state: AppState) -> bool:
    """Close open menus and lists, or else the help. Returns whether there was anything to close.

    The offer to continue closes itself, or the question that it asks.
    """
    anything = imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level
    if imgui.is_popup_open("", anything):
        imgui.internal.close_popup_to_level(0, True)
        return True
    shown, state.show_help = state.show_help or state.show_left_off, False
    return shown


def _fly(state: AppState, seconds: float) -> bool:
    if state.snapshot.scene is None:
        return False

    def held(name: str) -> float:
        return float(imgui.is_key_down(Chord.parse(name).key))

    right, up, forward = (held(plus) - held(minus) for plus, minus in FLY)
    if not (right or up or forward):
        return False
    state.camera.fly(right, up, forward, seconds, imgui.get_io().key_shift)
    state.current_view = None
    return True
