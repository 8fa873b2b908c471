"""The random user of tests/benchmarks/endurance.py writes nothing outside its own folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PLACES = """
import sys, tempfile
before = tempfile.gettempdir()
sys.path.insert(0, sys.argv[1])
import endurance
endurance.live_in(sys.argv[2])
from nerf_core.training import autosaves
print(tempfile.gettempdir(), *autosaves._spare_folders(), sep="\\n")
"""


def test_all_autosaves_of_the_random_user_go_to_its_own_folder(tmp_path: Path) -> None:
    benchmarks = Path(__file__).parent / "benchmarks"
    done = subprocess.run(
        [sys.executable, "-c", PLACES, str(benchmarks), str(tmp_path)], capture_output=True, text=True, check=True
    )
    places = [Path(line) for line in done.stdout.splitlines()]
    assert len(places) >= 3
    assert all(place.is_relative_to(tmp_path) for place in places)
