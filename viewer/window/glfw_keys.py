"""Map GLFW's keys and cursors to imgui's."""

from __future__ import annotations

from imgui_bundle import imgui  # before glfw: it names the GLFW library for both

import glfw  # isort: skip

_NAMED = {
    "TAB": "tab", "LEFT": "left_arrow", "RIGHT": "right_arrow", "UP": "up_arrow", "DOWN": "down_arrow",
    "PAGE_UP": "page_up", "PAGE_DOWN": "page_down", "HOME": "home", "END": "end", "INSERT": "insert",
    "DELETE": "delete", "BACKSPACE": "backspace", "SPACE": "space", "ENTER": "enter", "ESCAPE": "escape",
    "LEFT_CONTROL": "left_ctrl", "LEFT_SHIFT": "left_shift", "LEFT_ALT": "left_alt", "LEFT_SUPER": "left_super",
    "RIGHT_CONTROL": "right_ctrl", "RIGHT_SHIFT": "right_shift", "RIGHT_ALT": "right_alt",
    "RIGHT_SUPER": "right_super", "MENU": "menu", "APOSTROPHE": "apostrophe", "COMMA": "comma", "MINUS": "minus",
    "PERIOD": "period", "SLASH": "slash", "SEMICOLON": "semicolon", "EQUAL": "equal", "LEFT_BRACKET": "left_bracket",
    "BACKSLASH": "backslash", "RIGHT_BRACKET": "right_bracket", "GRAVE_ACCENT": "grave_accent",
    "CAPS_LOCK": "caps_lock", "SCROLL_LOCK": "scroll_lock", "NUM_LOCK": "num_lock", "PRINT_SCREEN": "print_screen",
    "PAUSE": "pause", "KP_DECIMAL": "keypad_decimal", "KP_DIVIDE": "keypad_divide", "KP_MULTIPLY": "keypad_multiply",
    "KP_SUBTRACT": "keypad_subtract", "KP_ADD": "keypad_add", "KP_ENTER": "keypad_enter", "KP_EQUAL": "keypad_equal",
}  # fmt: skip
_NAMED |= {letter: letter.lower() for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"}
_NAMED |= {digit: f"_{digit}" for digit in "0123456789"}
_NAMED |= {f"KP_{digit}": f"keypad{digit}" for digit in "0123456789"}
_NAMED |= {f"F{number}": f"f{number}" for number in range(1, 25)}

KEYS: dict[int, imgui.Key] = {
    getattr(glfw, f"KEY_{theirs}"): getattr(imgui.Key, ours) for theirs, ours in _NAMED.items()
}

MODIFIERS: dict[int, imgui.Key] = {
    glfw.MOD_CONTROL: imgui.Key.mod_ctrl,
    glfw.MOD_SHIFT: imgui.Key.mod_shift,
    glfw.MOD_ALT: imgui.Key.mod_alt,
    glfw.MOD_SUPER: imgui.Key.mod_super,
}

CURSORS: dict[int, int] = {
    imgui.MouseCursor_.arrow: glfw.ARROW_CURSOR,
    imgui.MouseCursor_.text_input: glfw.IBEAM_CURSOR,
    imgui.MouseCursor_.resize_all: glfw.RESIZE_ALL_CURSOR,
    imgui.MouseCursor_.resize_ns: glfw.RESIZE_NS_CURSOR,
    imgui.MouseCursor_.resize_ew: glfw.RESIZE_EW_CURSOR,
    imgui.MouseCursor_.resize_nesw: glfw.RESIZE_NESW_CURSOR,
    imgui.MouseCursor_.resize_nwse: glfw.RESIZE_NWSE_CURSOR,
    imgui.MouseCursor_.hand: glfw.POINTING_HAND_CURSOR,
    imgui.MouseCursor_.not_allowed: glfw.NOT_ALLOWED_CURSOR,
}
