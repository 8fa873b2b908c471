"""The Triton kernels, in a process that interprets them: in this one Triton may be imported already, to compile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.parametrize(
    ("checks", "fewest"), [(HERE / "test_packed_kernels.py", 18), (HERE.parent / "test_fixed_step.py", 4)]
)
def test_the_interpreted_kernels_pass_what_the_others_pass(checks: Path, fewest: int) -> None:
    pytest.importorskip("triton")
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", "triton", checks]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" PASSED") >= fewest
    assert " SKIPPED" not in done.stdout
