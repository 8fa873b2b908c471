"""Run a child process with a time limit, for libraries that crash or hang on damaged files."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Finished:
    """The result of a child process.

    output: its standard output.
    reason: empty if it succeeded, else the last line of its standard error, or "crash −N" for signal N.
    """

    output: bytes
    reason: str


def run_limited(command: Sequence[str], seconds: float) -> Finished:
    """Run a program without input. Raises subprocess.TimeoutExpired after `seconds`; the program is then killed."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, check=False)
    if done.returncode == 0:
        return Finished(done.stdout, "")
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return Finished(done.stdout, said[-1] if done.returncode > 0 and said else f"crash {done.returncode}")
