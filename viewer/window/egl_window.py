"""A window without a screen: an offscreen framebuffer in an EGL context. Code injects its input."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np

from nerf_core.common.errors import UserError

from . import DEBIAN_PACKAGES
from .triton_first import bind_triton

EGL_LIBRARY = "libEGL.so.1"  # the one that moderngl has loaded


class EglWindow:
    """A `viewer.window.Window` offscreen. Raises UserError if EGL or OpenGL 3.3 is missing."""

    has_display = False

    def __init__(self, size: tuple[int, int], scale: float = 1.0) -> None:
        bind_triton()
        try:
            settings: Any = {"backend": "egl"}  # moderngl's annotation of these is wrong
            self.context = moderngl.create_standalone_context(require=330, **settings)
        except Exception as error:  # moderngl raises plain Exception and ValueError for what the driver lacks
            raise UserError(
                f"cannot draw offscreen: no OpenGL 3.3 through EGL ({error}): install {DEBIAN_PACKAGES}"
            ) from error
        self._size = (0, 0)
        self._scale = scale
        self._awake = threading.Event()
        self._came = self._closing = False
        self._clipboard = ""
        self._closed = False
        self._make_framebuffer(1, 1)  # a framebuffer cannot have the size 0 of a minimised window
        self.resize(*size)

    @property
    def keeps(self) -> bool:
        return not self._empty

    def size(self) -> tuple[int, int]:
        return self._size

    def scale(self) -> float:
        return self._scale

    def resize(self, width: int, height: int) -> None:
        if (width, height) == self._size:
            return
        self._size = (width, height)
        if width and height:
            self._free_framebuffer()
            self._make_framebuffer(width, height)
        self._came = True
        self.wake()

    def _make_framebuffer(self, width: int, height: int) -> None:
        self._color = self.context.texture((width, height), 4)
        self.framebuffer = self.context.framebuffer([self._color])
        self.framebuffer.use()
        self._empty = True  # until the first frame is drawn

    def _free_framebuffer(self) -> None:
        self.framebuffer.release()
        self._color.release()

    def poll(self, timeout: float) -> bool:
        self._awake.wait(timeout)
        self._awake.clear()
        came, self._came = self._came, False
        return came

    def swap(self) -> None:
        self.context.finish()
        self._empty = False

    def read_pixels(self) -> np.ndarray:
        width, height = self._size
        if not (width and height):
            return np.zeros((height, width, 3), np.uint8)
        pixels = np.frombuffer(self.framebuffer.read(components=3, alignment=1), np.uint8)
        return pixels.reshape(height, width, 3)[::-1].copy()

    def should_close(self) -> bool:
        return self._closing

    def request_close(self) -> None:
        self._came = self._closing = True
        self.wake()

    def set_cursor(self, cursor: int) -> None:
        pass  # nothing shows it

    def clipboard(self) -> str:
        return self._clipboard

    def set_clipboard(self, text: str) -> None:
        self._clipboard = text

    def wake(self) -> None:
        self._awake.set()

    def when_lost(self, do: Callable[[], None]) -> None:
        pass  # there is no screen to lose

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._free_framebuffer()
        self.context.release()
        # moderngl leaves the released context current on this thread, and a GLX window could not replace it.
        ctypes.CDLL(EGL_LIBRARY).eglReleaseThread()
