"""The Triton kernels, in a process that interprets them: in this one Triton may be imported already, to compile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CHECKS = [HERE / "test_packed_kernels.py", HERE.parent / "test_fixed_step.py"]


def test_the_interpreted_kernels_pass_what_the_others_pass() -> None:
    pytest.importorskip("triton")
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", *map(str, CHECKS)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("[triton") >= 10
    assert " skipped" not in done.stdout
