"""Weights survive the loss of the window: the X server dies, another client closes it, or its thread hangs."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from desk import PATIENCE

from nerf_core.training.checkpoint import describe

Server = tuple[str, "subprocess.Popen[bytes]"]
OPTIONS = ["--method", "voxels", "--device", "cpu", "--threads", "1", "--downscale", "8", "--size", "640x400"]


@contextmanager
def training_window(display: str, home: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run `nerf-viewer` in a window on a display. It trains when this yields, because its progress is printed."""
    own = {"DISPLAY": display, "WAYLAND_DISPLAY": "", "XDG_CONFIG_HOME": str(home / "c"), "XDG_DATA_HOME": str(home)}
    # the screenshot makes the command print its progress
    asked = ["--steps", "100000", "--screenshot", str(home / "shot.png"), *options]
    command = [sys.executable, "-m", "viewer.cli", *OPTIONS, *asked]
    environment, pipe = {**os.environ, **own}, subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            assert any(line.startswith("training: ") for line in process.stdout)
            yield process
        finally:
            process.kill()


def check_saved(process: subprocess.Popen[str], home: Path, status: int) -> None:
    """The process ends with a status, and its last line names a checkpoint that can be read."""
    out, err = process.communicate(timeout=PATIENCE)
    (saved,) = home.glob("nerf-viewer/autosave/*.safetensors")
    assert describe(saved)["step"] > 0
    assert str(saved) in out + err
    assert process.returncode == status
    assert "Traceback" not in err


@pytest.mark.thorough(12)
def test_a_dead_x_server_loses_no_weights(own_server: Server, tmp_path: Path) -> None:
    display, server = own_server
    with training_window(display, tmp_path) as process:
        server.kill()
        check_saved(process, tmp_path, 1)


@pytest.mark.thorough(9)
@pytest.mark.skipif(shutil.which("xdotool") is None, reason="needs xdotool")
def test_a_window_closed_by_another_client_loses_no_weights(own_server: Server, tmp_path: Path) -> None:
    display, _ = own_server
    with training_window(display, tmp_path) as process:
        kill = ["xdotool", "search", "--sync", "--onlyvisible", "--class", "nerf-viewer", "windowkill"]
        subprocess.run(kill, env={**os.environ, "DISPLAY": display}, check=True, timeout=PATIENCE)
        check_saved(process, tmp_path, 1)


@pytest.mark.thorough(14)
def test_a_window_whose_server_hangs_saves_at_a_signal(own_server: Server, tmp_path: Path) -> None:
    display, server = own_server
    with training_window(display, tmp_path) as process:
        server.send_signal(signal.SIGSTOP)
        process.send_signal(signal.SIGTERM)
        check_saved(process, tmp_path, 143)
