"""Notice that the connection to the X server broke: the server ended, or another client closed the connection."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

_IO_ERROR_HANDLER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_kept: list[Any] = []  # Xlib keeps no reference to the handler, so that Python would free it


def when_connection_is_lost(do: Callable[[], None]) -> None:
    """Call `do` when an X11 connection of this process breaks. `do` must end the process.

    Xlib calls its handler for fatal errors inside of whatever call found the connection broken, with Xlib's locks held,
    and ends the process when the handler returns. So `do` runs in the thread that owns the window, must make no call
    of X11, GLFW or OpenGL, and must not return.
    """
    library = ctypes.CDLL("libX11.so.6")  # GLFW has opened this very library
    handler = _IO_ERROR_HANDLER(lambda _display: do() or 0)
    library.XSetIOErrorHandler.argtypes = [_IO_ERROR_HANDLER]
    library.XSetIOErrorHandler.restype = ctypes.c_void_p
    library.XSetIOErrorHandler(handler)
    _kept[:] = [handler]
