"""An output that cannot be written ends no training: a full device, a closed pipe, a terminal that was closed."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest
from desk import PATIENCE

from nerf_core.training import checkpoint

TRAIN = [
    "train", "--method", "nerf", "--device", "cpu", "--threads", "1", "--downscale", "12", "--set", "rays=16",
    "--set", "coarse_samples=8", "--set", "fine_samples=8", "--set", "depth=2", "--set", "width=16",
]  # fmt: skip


def core(*words: str) -> list[str]:
    return [sys.executable, "-m", "nerf_core.cli", *words]


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_training_goes_on_when_the_device_of_its_output_is_full(stream: str, tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | {stream: full}
        words = core(*TRAIN, "--steps", "5", "--out", str(tmp_path))
        done = subprocess.run(words, **pipes, text=True, timeout=PATIENCE, check=False)  # pyright: ignore[reportCallIssue, reportArgumentType]
    assert done.returncode == 0
    assert checkpoint.newest(tmp_path)[1]["step"] == 5
    if stream == "stdout":
        assert done.stderr.startswith("nerf-core: the output is incomplete: No space left")
        assert done.stderr.count("\n") == 1


def test_training_goes_on_when_the_reader_of_its_output_leaves(tmp_path: Path) -> None:
    words = core(*TRAIN, "--steps", "5", "--out", str(tmp_path))
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        done = subprocess.run(words, stdout=pipe, stderr=subprocess.PIPE, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert checkpoint.newest(tmp_path)[1]["step"] == 5


def test_a_closed_terminal_saves_what_was_trained(hangup: None, tmp_path: Path) -> None:
    """The system sends SIGHUP to the terminal's programs, and all that they print from then on fails with EIO."""
    ours, theirs = pty.openpty()
    words = core(*TRAIN, "--steps", "1000000", "--out", str(tmp_path))
    # makes the terminal that of its session, so that it gets the SIGHUP
    begin = (
        "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.executable, sys.argv[1:])"
    )
    words = [sys.executable, "-c", begin, *words]
    process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    told = b""
    while b"rays/s" not in told:  # it trains
        told += os.read(ours, 1000)
    os.close(ours)
    assert process.wait(timeout=PATIENCE) == 129
    assert checkpoint.newest(tmp_path)[1]["step"] > 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_report_that_cannot_be_written_is_an_error() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(core("methods"), stdout=full, stderr=subprocess.PIPE, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(b"nerf-core: the output is incomplete: No space left")
