"""The windows that the app draws into: one on a screen and one offscreen, with one interface."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from nerf_core.common.errors import UserError

if TYPE_CHECKING:
    import moderngl

DEBIAN_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri libx11-6 libxext6 libxcb1"
DEFAULT_SIZE = (1440, 900)


class DisplayError(UserError):
    """There is no screen to open a window on; offscreen drawing may still work."""


class Window(Protocol):
    """A framebuffer, its GL context (3.3 core) and the user's input. One thread makes all calls except `wake`.

    All lengths are in framebuffer pixels, y down, like imgui's.
    """

    context: moderngl.Context
    framebuffer: moderngl.Framebuffer  # its viewport always covers size()
    has_display: bool

    @property
    def keeps(self) -> bool:
        """Whether the framebuffer still has what was in it at the last `swap`. Not after it got a new size."""
        ...

    def size(self) -> tuple[int, int]:
        """Return the framebuffer's width and height; (0, 0) while minimised."""
        ...

    def scale(self) -> float:
        """Return the pixels per point of the screen; text and lengths are multiplied by it."""
        ...

    def resize(self, width: int, height: int) -> None: ...

    def poll(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for input or `wake`, and pass input to imgui. Returns whether input came.

        A new size counts as input, and so does everything else that needs a redraw.
        """
        ...

    def swap(self) -> None: ...

    def read_pixels(self) -> np.ndarray:
        """Return what has been drawn since the last swap: uint8 (H, W, 3), row 0 at the top."""
        ...

    def should_close(self) -> bool: ...

    def request_close(self) -> None: ...

    def set_cursor(self, cursor: int) -> None:
        """Show one of imgui.MouseCursor_."""
        ...

    def clipboard(self) -> str: ...

    def set_clipboard(self, text: str) -> None: ...

    def wake(self) -> None:
        """Make `poll` return now. Any thread may call it."""
        ...

    def when_lost(self, do: Callable[[], None]) -> None:
        """Call `do` if the connection to the screen breaks, inside of the call that finds it broken.

        `do` must not return.
        """
        ...

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        ...


def load_libraries() -> None:
    """Import the modules that need the system's GL and X11 libraries. Raises UserError that names Debian's packages."""
    try:
        import imgui_bundle  # noqa: F401, I001  first: it names the GLFW library that glfw then loads
        import glfw  # noqa: F401
        import moderngl  # noqa: F401
    except (ImportError, OSError) as error:
        raise UserError(f"a system library is missing ({error}): install {DEBIAN_PACKAGES}") from error


def open_window(title: str, size: tuple[int, int] = DEFAULT_SIZE) -> Window:
    """Open a window on the user's screen. Raises DisplayError without a screen, UserError without OpenGL 3.3."""
    load_libraries()
    from .glfw_window import GlfwWindow

    return GlfwWindow(title, size)


def open_offscreen(size: tuple[int, int] = DEFAULT_SIZE, scale: float = 1.0) -> Window:
    """Open an offscreen window: through EGL, or else a hidden window. Raises UserError without OpenGL 3.3."""
    load_libraries()
    if sys.platform in ("win32", "darwin"):
        from .glfw_window import GlfwWindow

        return GlfwWindow("offscreen", size, visible=False)
    from .egl_window import EglWindow

    return EglWindow(size, scale)
