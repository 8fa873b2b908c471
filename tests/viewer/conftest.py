"""Fixtures: a virtual display, windows on it and offscreen, and an imgui context."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from viewer.window import Window, open_offscreen, open_window

SIZE = (640, 480)


@pytest.fixture(scope="session", autouse=True)
def data_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder where closing sessions save unsaved weights, instead of the user's own."""
    folder = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(folder))
        yield folder


@contextmanager
def x_server() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run a virtual X server (Xvfb). Yields its display's name and its process."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb (Debian package xvfb)")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp", "-noreset"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        os.close(write)
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb did not start"
        try:
            yield f":{number}", server
        finally:
            server.send_signal(signal.SIGCONT)  # a stopped one would not see the SIGTERM
            server.terminate()


@pytest.fixture(scope="session")
def display() -> Iterator[str]:
    """A virtual display: the tests neither need nor disturb the user's screen."""
    with x_server() as (name, _):
        yield name


@pytest.fixture
def own_server() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A virtual display of the test's own, which it may break: its name and the server's process."""
    with x_server() as server:
        yield server


@pytest.fixture(params=["egl", "glfw"])
def window(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Window]:
    """Each kind of window in turn."""
    if request.param == "glfw":
        monkeypatch.setenv("DISPLAY", request.getfixturevalue("display"))
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        window = open_window("test", SIZE)
    else:
        window = open_offscreen(SIZE)
    with _imgui_context():
        yield window
    window.close()


@pytest.fixture
def offscreen() -> Iterator[Callable[..., Window]]:
    """A function that opens offscreen windows. They are closed after the test."""
    opened: list[Window] = []

    def open_one(size: tuple[int, int] = SIZE, scale: float = 1.0) -> Window:
        opened.append(open_offscreen(size, scale))
        return opened[-1]

    yield open_one
    for window in opened:
        window.close()


class _imgui_context:  # noqa: N801  a context manager, used like a function
    def __enter__(self) -> None:
        from imgui_bundle import imgui

        self._context = imgui.create_context()
        imgui.get_io().set_ini_filename(None)

    def __exit__(self, *_: object) -> None:
        from imgui_bundle import imgui

        imgui.destroy_context(self._context)


@pytest.fixture
def imgui_context() -> Iterator[None]:
    with _imgui_context():
        yield
