"""The save at the end takes its time and says so. A second signal ends it. The next start clears what is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from desk import PATIENCE

from nerf_core.common.files import PREFIX, SUFFIX
from nerf_core.common.signals import Signals
from nerf_core.training.checkpoint import describe
from nerf_core.training.settings import RunSettings
from viewer.session.session import Session
from viewer.window import Window

OPTIONS = ["--method", "voxels", "--device", "cpu", "--threads", "1", "--downscale", "8", "--size", "320x200"]
SLOW = 5.0  # seconds that a save takes here: more than the 4 that a save at the end once had
ENDLESS = 20.0  # seconds of a save that is not waited for: an end at once is far from it, also on a busy machine
# the disk is slow, and nothing else is pretended
CODE = """
import os, sys, time
real = os.fsync
def fsync(number):
    if os.fstat(number).st_size > 100_000:  # not that of the layout
        print("SAVING", flush=True)
        time.sleep(float(os.environ["SLOW"]))
    real(number)
os.fsync = fsync
from viewer.cli import command
command()
"""


@contextmanager
def saving(home: Path, *options: str, display: str = "", slow: float = SLOW) -> Iterator[subprocess.Popen[str]]:
    """Run `nerf-viewer` with a slow disk. It trains when this yields, because its progress is printed."""
    own = {"XDG_CONFIG_HOME": str(home / "c"), "XDG_DATA_HOME": str(home), "TMPDIR": str(home / "t")}
    (home / "t").mkdir()
    own |= {"DISPLAY": display, "WAYLAND_DISPLAY": "", "SLOW": str(slow)}
    asked = ["--steps", "1000000", "--screenshot", str(home / "shot.png"), *options]
    command, pipe = [sys.executable, "-c", CODE, *OPTIONS, *asked], subprocess.PIPE
    with subprocess.Popen(command, env={**os.environ, **own}, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            wait_for(process, "training: ")
            yield process
        finally:
            process.kill()


def wait_for(process: subprocess.Popen[str], words: str) -> None:
    assert process.stdout is not None
    assert any(line.startswith(words) for line in process.stdout)


@pytest.mark.thorough(15)
def test_a_slow_save_is_finished_and_told_of(tmp_path: Path) -> None:
    with saving(tmp_path, "--headless") as process:
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE)
    (saved,) = tmp_path.glob("nerf-viewer/autosave/*.safetensors")
    assert describe(saved)["step"] > 0
    assert (process.returncode, str(saved) in out) == (143, True)
    assert "takes 2 s so far; Ctrl-C ends without saving" in err
    assert not list(tmp_path.rglob(f"*{SUFFIX}"))


@pytest.mark.thorough(10)
def test_a_second_signal_ends_a_save_at_once(tmp_path: Path) -> None:
    with saving(tmp_path, "--headless", slow=ENDLESS) as process:
        process.send_signal(signal.SIGTERM)
        wait_for(process, "SAVING")
        time.sleep(1)  # a signal that comes together with the first counts as the same
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE)
    assert time.monotonic() - begin < ENDLESS / 2
    assert (process.returncode, err) == (130, "nerf-viewer: interrupted (SIGINT)\n")


@pytest.mark.thorough(14)
def test_a_second_signal_ends_the_save_of_a_window_that_hangs(
    own_server: tuple[str, subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    display, server = own_server
    with saving(tmp_path, display=display, slow=ENDLESS) as process:
        server.send_signal(signal.SIGSTOP)
        time.sleep(1)  # until the window waits for it
        try:
            process.send_signal(signal.SIGTERM)
            wait_for(process, "SAVING")
            time.sleep(1)
            begin = time.monotonic()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=PATIENCE) == 130
            assert time.monotonic() - begin < ENDLESS / 2
        finally:
            server.send_signal(signal.SIGCONT)


def test_leftovers_of_the_last_save_are_cleared_at_the_next_start(
    offscreen: Callable[..., Window], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever a last save may go: the user's data, or the temporary folder. Foreign files stay."""
    temporary, data = tmp_path / "temporary", tmp_path / "nerf-viewer" / "autosave"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    for folder in (temporary, data):
        folder.mkdir(parents=True)
        (folder / f"{PREFIX}1{SUFFIX}").write_bytes(b"half")
        (folder / "download.part").write_bytes(b"foreign")
    with Signals() as signals:
        Session(offscreen((320, 200)), RunSettings(), signals, print).close()
    assert [path.name for folder in (temporary, data) for path in folder.iterdir()] == ["download.part"] * 2
