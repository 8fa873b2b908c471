"""A child process ends in time, and says why it failed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from nerf_core.common.subprograms import Finished, run_limited


def python(code: str, seconds: float = 60.0) -> Finished:
    return run_limited([sys.executable, "-S", "-c", code], seconds)


def test_output_and_reason() -> None:
    assert python("print('found')") == Finished(b"found\n", "")
    assert python("import sys; print('part'); sys.exit('first\\nlast')") == Finished(b"part\n", "last")


def test_a_crash_is_reported_by_its_signal() -> None:
    assert python("import os; os.abort()").reason == "crash -6"


def test_it_is_killed_after_its_time() -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        python("while True: pass", 0.5)
