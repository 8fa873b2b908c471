"""A window on the user's screen through GLFW. GLFW requires the main thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np
from imgui_bundle import imgui  # before glfw: it names the GLFW library for both
from PIL import Image

import glfw  # isort: skip

from nerf_core.common.assets import assets_dir
from nerf_core.common.errors import UserError

from . import DEBIAN_PACKAGES, DEFAULT_SIZE, DisplayError
from .glfw_keys import CURSORS, KEYS, MODIFIERS
from .triton_first import bind_triton
from .x11_connection import when_connection_is_lost

ICON_PIXELS = 64  # the size in title bars and task lists
MOUSE_BUTTONS = 5  # as many as imgui knows


class _GlfwLoader:
    """Finds GL functions through GLFW: moderngl's own search assumes X11 and fails under Wayland."""

    def __enter__(self) -> _GlfwLoader:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def load_opengl_function(self, name: str) -> int:
        return glfw.get_proc_address(name) or 0  # pyright: ignore[reportReturnType]  an int, whatever its stub says

    load = load_opengl_function

    def release(self) -> None:
        pass


class GlfwWindow:
    """A `viewer.window.Window` on a screen. Raises DisplayError without a screen, UserError without OpenGL 3.3."""

    def __init__(self, title: str, size: tuple[int, int], visible: bool = True) -> None:
        bind_triton()
        glfw.ERROR_REPORTING = "ignore"  # errors are read with get_error; a missing cursor shape does not matter
        if not glfw.init():
            raise DisplayError(f"cannot open a window: {_glfw_error()}: set DISPLAY or use --headless")
        self.has_display = visible
        self._handle = self._create(title, size, visible)
        self._cursors: dict[int, Any] = {}
        self._cursor = -1  # the shape that is shown
        self._came = False
        self._closed = False
        try:
            self._prepare()
        except BaseException:
            self._destroy()
            raise

    def _prepare(self) -> None:
        glfw.make_context_current(self._handle)
        glfw.swap_interval(0)  # the app paces itself; waiting for the screen here would delay input
        try:
            self.context = moderngl.create_context(require=330, context=_GlfwLoader())  # pyright: ignore[reportArgumentType]  duck-typed
        except Exception as error:  # moderngl raises plain Exception and ValueError for what the driver lacks
            raise UserError(f"cannot draw: no OpenGL 3.3 ({error}): install {DEBIAN_PACKAGES}") from error
        self.framebuffer = self.context.detect_framebuffer(0)
        self._emptied = 0  # how many frames from now on may begin with an empty framebuffer
        self._copies = self._find_out_copies()
        self._connect()
        if self.has_display:
            self._set_icon()
        self._resized()

    @property
    def keeps(self) -> bool:
        return self._copies and not self._emptied

    def _find_out_copies(self) -> bool:
        """Find out by trial whether the framebuffer keeps what was drawn when it is shown.

        OpenGL leaves that open. Mesa's software renderers copy it to an X11 window, so it stays. A graphics card mostly
        exchanges two or three buffers, when it likes, and does not need to save pixels.
        """
        if glfw.get_platform() != glfw.PLATFORM_X11 or "pipe" not in self.context.info["GL_RENDERER"]:
            return False
        for shade in range(1, 4):  # nearly black: nobody sees it
            self.framebuffer.clear(shade / 255, shade / 255, shade / 255, 1.0)
            self.swap()
            if self.framebuffer.read(viewport=(0, 0, 1, 1), components=3) != bytes([shade] * 3):
                return False
        return True

    @staticmethod
    def _create(title: str, size: tuple[int, int], visible: bool) -> Any:
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)  # macOS gives a core profile only with this hint
        glfw.window_hint(glfw.DEPTH_BITS, 0)  # the window needs no depth buffer, and clearing one takes time
        glfw.window_hint(glfw.STENCIL_BITS, 0)
        glfw.window_hint(glfw.SRGB_CAPABLE, False)  # colours reach the screen unchanged
        glfw.window_hint(glfw.VISIBLE, visible)
        glfw.window_hint(glfw.SCALE_TO_MONITOR, visible)
        glfw.window_hint_string(glfw.X11_CLASS_NAME, "nerf-viewer")
        glfw.window_hint_string(glfw.WAYLAND_APP_ID, "nerf-viewer")
        handle = glfw.create_window(*size, title, None, None)
        if not handle:
            error = _glfw_error()
            glfw.terminate()
            raise UserError(f"cannot open a window with OpenGL 3.3: {error}: install {DEBIAN_PACKAGES}")
        monitor = glfw.get_primary_monitor()
        if visible and monitor and size == DEFAULT_SIZE:  # a size that was asked for is kept
            *_, width, height = glfw.get_monitor_workarea(monitor)
            now = glfw.get_window_size(handle)
            fitting = min(now[0], width), min(now[1], height)
            if fitting != now and min(fitting) > 0:
                glfw.set_window_size(handle, *fitting)
        return handle

    def _set_icon(self) -> None:
        with Image.open(assets_dir() / "icon.png") as icon:
            pixels = np.asarray(icon.convert("RGBA").resize((ICON_PIXELS, ICON_PIXELS), Image.Resampling.LANCZOS))
        images: Any = [(ICON_PIXELS, ICON_PIXELS, pixels.tolist())]  # its stub has another type
        glfw.set_window_icon(self._handle, 1, images)

    def _connect(self) -> None:
        glfw.set_key_callback(self._handle, self._on_key)
        glfw.set_char_callback(self._handle, lambda _, code: self._io().add_input_character(code))
        glfw.set_cursor_pos_callback(self._handle, self._on_move)
        glfw.set_cursor_enter_callback(self._handle, self._on_enter)
        glfw.set_mouse_button_callback(self._handle, self._on_button)
        glfw.set_scroll_callback(self._handle, lambda _, x, y: self._io().add_mouse_wheel_event(x, y))
        glfw.set_window_focus_callback(self._handle, lambda _, focused: self._io().add_focus_event(bool(focused)))
        glfw.set_framebuffer_size_callback(self._handle, lambda *_: self._resized())
        glfw.set_window_content_scale_callback(self._handle, lambda *_: self._resized())
        glfw.set_window_refresh_callback(self._handle, lambda _: self._note())
        glfw.set_window_close_callback(self._handle, lambda _: self._note())

    # ---- input ------------------------------------------------------------------------------------------------

    def _note(self) -> None:
        self._came = True

    def _io(self) -> imgui.IO:
        self._came = True
        return imgui.get_io()

    def _resized(self) -> None:
        # Asked only now: each call of GLFW lets the worker's Python run, which costs milliseconds within a frame.
        self._scale = max(glfw.get_window_content_scale(self._handle))
        self._came = True
        self.framebuffer.viewport = (0, 0, *self.size())
        # Mesa makes a new framebuffer when it hears of another size, which can be a frame before or after this, and the
        # size may be the old one again by then.
        self._emptied = 2

    def _on_key(self, _window: Any, key: int, _scancode: int, action: int, modifiers: int) -> None:
        io = self._io()
        if action == glfw.REPEAT or key not in KEYS:
            return  # imgui repeats keys itself
        down = action == glfw.PRESS
        self._send_modifiers(io, modifiers, key, down)
        io.add_key_event(KEYS[key], down)

    @staticmethod
    def _send_modifiers(io: imgui.IO, modifiers: int, key: int = -1, down: bool = False) -> None:
        # X11 reports the modifiers as they were before the event, so a modifier key sets its own bit.
        own = {
            glfw.KEY_LEFT_CONTROL: glfw.MOD_CONTROL, glfw.KEY_RIGHT_CONTROL: glfw.MOD_CONTROL,
            glfw.KEY_LEFT_SHIFT: glfw.MOD_SHIFT, glfw.KEY_RIGHT_SHIFT: glfw.MOD_SHIFT,
            glfw.KEY_LEFT_ALT: glfw.MOD_ALT, glfw.KEY_RIGHT_ALT: glfw.MOD_ALT,
            glfw.KEY_LEFT_SUPER: glfw.MOD_SUPER, glfw.KEY_RIGHT_SUPER: glfw.MOD_SUPER,
        }.get(key)  # fmt: skip
        for bit, modifier in MODIFIERS.items():
            io.add_key_event(modifier, down if bit == own else bool(modifiers & bit))

    def _on_button(self, _window: Any, button: int, action: int, modifiers: int) -> None:
        io = self._io()
        self._send_modifiers(io, modifiers)
        if button < MOUSE_BUTTONS:
            io.add_mouse_button_event(button, action == glfw.PRESS)

    def _on_move(self, _window: Any, x: float, y: float) -> None:
        # GLFW reports points here; imgui works in framebuffer pixels.
        width, height = glfw.get_window_size(self._handle)
        pixels = self.size()
        self._io().add_mouse_pos_event(x * pixels[0] / max(width, 1), y * pixels[1] / max(height, 1))

    def _on_enter(self, _window: Any, entered: int) -> None:
        if not entered and not any(glfw.get_mouse_button(self._handle, b) for b in range(MOUSE_BUTTONS)):
            self._io().add_mouse_pos_event(-1e9, -1e9)  # outside nothing is hovered; during a drag the pointer stays

    # ---- the contract -----------------------------------------------------------------------------------------

    def size(self) -> tuple[int, int]:
        # This asks the X server. If that hangs, the window's thread waits here, where it does not hold Python's lock:
        # inside OpenGL it would, and nobody could save what was trained (`viewer.session.rescue`).
        return glfw.get_framebuffer_size(self._handle)

    def scale(self) -> float:
        return self._scale

    def resize(self, width: int, height: int) -> None:
        window, pixels = glfw.get_window_size(self._handle), self.size()
        ratio = window[0] / pixels[0] if pixels[0] else 1.0
        glfw.set_window_size(self._handle, round(width * ratio), round(height * ratio))
        self._resized()

    def poll(self, timeout: float) -> bool:
        self._came = False
        if timeout > 0:
            glfw.wait_events_timeout(timeout)
        else:
            glfw.poll_events()
        return self._came

    def swap(self) -> None:
        glfw.swap_buffers(self._handle)
        self._emptied = max(self._emptied - 1, 0)

    def read_pixels(self) -> np.ndarray:
        width, height = self.size()
        if not (width and height):
            return np.zeros((height, width, 3), np.uint8)
        data = self.framebuffer.read(viewport=(0, 0, width, height), components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1].copy()

    def should_close(self) -> bool:
        return bool(glfw.window_should_close(self._handle))

    def request_close(self) -> None:
        glfw.set_window_should_close(self._handle, True)
        self.wake()

    def set_cursor(self, cursor: int) -> None:
        shape = CURSORS.get(cursor, CURSORS[imgui.MouseCursor_.arrow])
        if shape == self._cursor:
            return
        self._cursor = shape
        if shape not in self._cursors:
            self._cursors[shape] = glfw.create_standard_cursor(shape)  # None if the system does not have this shape
        glfw.set_cursor(self._handle, self._cursors[shape])

    def clipboard(self) -> str:
        no_window: Any = None  # GLFW no longer needs a window here, but its stubs do
        return _text(glfw.get_clipboard_string(no_window))

    def set_clipboard(self, text: str) -> None:
        no_window: Any = None
        glfw.set_clipboard_string(no_window, text)

    def wake(self) -> None:
        glfw.post_empty_event()

    def when_lost(self, do: Callable[[], None]) -> None:
        # under Wayland GLFW asks the window to close then; Windows and macOS do not lose a screen
        if glfw.get_platform() == glfw.PLATFORM_X11:
            when_connection_is_lost(do)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.context.release()
            self._destroy()

    def _destroy(self) -> None:
        glfw.destroy_window(self._handle)
        glfw.terminate()


def _glfw_error() -> str:
    _code, message = glfw.get_error()
    return _text(message).strip() or "GLFW gives no reason"


def _text(raw: Any) -> str:
    """A string of GLFW as str. They are bytes or None, although the stubs say str."""
    return raw.decode("utf-8", "replace") if raw else ""
