"""What the app draws into: a window on a screen, or the same thing offscreen, behind one contract."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Protocol

import numpy as np

# Before any GL context: torch.optim loads torch._dynamo, and with it triton, on first use. Triton's exported LLVM
# symbols clash with those of Mesa's drivers, and the process would die in the middle of training.
import torch
import torch._dynamo  # noqa: F401

from nerf_core.common.errors import UserError

if TYPE_CHECKING:
    import moderngl

DEBIAN_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri libx11-6 libxext6 libxcb1"
DEFAULT_SIZE = (1440, 900)


class DisplayError(UserError):
    """There is no screen to open a window on; offscreen drawing may still work."""


class Window(Protocol):
    """A framebuffer, its GL context (3.3 core) and the user's input. All calls but `wake` come from one thread.

    Every length is in framebuffer pixels, y down; imgui works in the same pixels.
    """

    context: moderngl.Context
    framebuffer: moderngl.Framebuffer  # its viewport always covers size()
    has_display: bool

    def size(self) -> tuple[int, int]:
        """Framebuffer width and height; (0, 0) while minimised."""
        ...

    def scale(self) -> float:
        """Pixels per point of the screen: what text and lengths are multiplied by."""
        ...

    def resize(self, width: int, height: int) -> None: ...

    def poll(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for input or `wake`, hand input to imgui's io; whether input came.

        Input is also a new size and whatever else asks for a redraw.
        """
        ...

    def swap(self) -> None: ...

    def read_pixels(self) -> np.ndarray:
        """What has been drawn since the last swap: uint8 (H, W, 3), row 0 at the top."""
        ...

    def should_close(self) -> bool: ...

    def request_close(self) -> None: ...

    def set_title(self, title: str) -> None: ...

    def set_cursor(self, cursor: int) -> None:
        """Show one of imgui.MouseCursor_."""
        ...

    def clipboard(self) -> str: ...

    def set_clipboard(self, text: str) -> None: ...

    def wake(self) -> None:
        """Make `poll` return now; callable from any thread."""
        ...

    def close(self) -> None:
        """Free the context; calling it again does nothing."""
        ...


def load_libraries() -> None:
    """Import what needs the system's GL and X11 libraries. Raises UserError naming Debian's packages."""
    try:
        import imgui_bundle  # noqa: F401, I001  first: it names the GLFW library that glfw then loads
        import glfw  # noqa: F401
        import moderngl  # noqa: F401
    except (ImportError, OSError) as error:
        raise UserError(f"a system library is missing ({error}): install {DEBIAN_PACKAGES}") from error


def open_window(title: str, size: tuple[int, int] = DEFAULT_SIZE) -> Window:
    """A window on the user's screen. Raises DisplayError without one, UserError without OpenGL 3.3."""
    load_libraries()
    from .glfw_window import GlfwWindow

    return GlfwWindow(title, size)


def open_offscreen(size: tuple[int, int] = DEFAULT_SIZE, scale: float = 1.0) -> Window:
    """The same without a screen: EGL where there is one, else a hidden window. Raises UserError without OpenGL 3.3."""
    load_libraries()
    if sys.platform in ("win32", "darwin"):
        from .glfw_window import GlfwWindow

        return GlfwWindow("offscreen", size, visible=False)
    from .egl_window import EglWindow

    return EglWindow(size, scale)
