"""An addition is one new file in its folder: the program offers what it adds, and the tests of its kind run it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import additions
import pages
import pytest

ROOT = Path(__file__).parent.parent
METHOD = "nerf_core/methods/grid.py"
# Prints for each kind whether the addition shows up. The program runs once, with the new files in its packages.
LOOK = """
import contextlib, io, json, sys
from pathlib import Path
import additions
additions.extend(Path(sys.argv[1]))
from nerf_core.cli import main
def printed(*words):
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(words)
    return out.getvalue()
help, render, lab = printed("--help"), printed("render", "--help"), printed("lab", "--help")
from nerf_core.datasets.capture import DATASETS
from nerf_core.kernels.choice import VOXEL_KERNELS
from nerf_core.live.shares import SHARES
from nerf_core.methods import METHODS
from nerf_core.probe.verdicts import VERDICTS
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.rendering.modes import mode_names
from viewer.commands.overview import overview
from viewer.ui.contract import PANELS
print(json.dumps({
    "format": "csv" in DATASETS.names(), "method": "grid" in METHODS.names(), "mode": "opacity" in mode_names(),
    "kernel": "checked" in VOXEL_KERNELS.names(), "share rule": "smooth" in SHARES.names(),
    "verdict": "wrong colour" in VERDICTS.names(), "model export": "points" in EXPORTS.names(),
    "panel": any("nearest_photo" in PANELS.get(name).__module__ for name in PANELS.names()),
    "key": "Home" in str(overview()), "path": "approach" in render and "--left" in render,
    "subcommand": "photos" in help, "study": "number of training photos" in lab,
    "export's subcommand": "export" in help,
}))
"""


@pytest.fixture(scope="module")
def extra(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files of docs/extending.md, and the method in examples/ that the page names."""
    extra = tmp_path_factory.mktemp("additions")
    for path, text in pages.files().items():
        (extra / path).parent.mkdir(parents=True, exist_ok=True)
        (extra / path).write_text(text, encoding="utf-8")
    (extra / METHOD).parent.mkdir(parents=True)
    shutil.copy(ROOT / "examples" / "own_field_as_a_method.py", extra / METHOD)
    return extra


def python(extra: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the root of the repository, where it finds tests/helpers/additions.py."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])
    environment = {**os.environ, "PYTHONPATH": path, "ADDITIONS": str(extra), "SHIPPED": "|".join(additions.names())}
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, cwd=ROOT, env=environment
    )


@pytest.fixture(scope="module")
def found(extra: Path) -> dict[str, bool]:
    done = python(extra, "-c", LOOK, str(extra))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


KINDS = (
    "format", "method", "mode", "kernel", "share rule", "verdict", "model export", "panel", "key", "path", "subcommand",
    "export's subcommand", "study",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_an_addition_is_one_new_file(found: dict[str, bool], kind: str) -> None:
    assert found[kind]


def test_every_kind_is_looked_for(found: dict[str, bool]) -> None:
    assert set(found) == set(KINDS)
    assert len(pages.files()) + 1 == len(KINDS) - 1  # the method is in examples/; one file makes two kinds


@pytest.mark.timeout(1800)
@pytest.mark.thorough(45)
def test_all_additions_pass_the_tests_of_their_kinds(extra: Path) -> None:
    """Run the tests that the page names, except for the table of keys, to which the page says to add the new keys."""
    files = list(dict.fromkeys(re.findall(r"`(tests/[\w/]+\.py)`", pages.PAGE.read_text(encoding="utf-8"))))
    files.remove("tests/benchmarks/verdicts.py")  # a measurement
    table = "tests/viewer/commands/test_registry.py::test_the_documented_table_of_keys_matches_the_registry"
    # what takes long and is not about one addition
    long = ("signals", "window", "cancelled", "own_checkpoint", "probe_opens", "two_instances", "veil", "missing_row")
    words = " and ".join(f"not {word}" for word in long)
    options = ["-v", "-n0", "-p", "additions", "-p", "no:cacheprovider", "-k", words, "--deselect", table]
    done = python(extra, "-m", "pytest", *options, *files)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("csv", "grid", "checked", "opacity", "approach", "points", "wrong colour", "smooth", "nearest_photo"):
        assert re.search(rf"\[(.*-)?{name}\b.* PASSED", done.stdout), name
    for name in ("photos", "camera.first"):
        assert re.search(rf"\[{re.escape(name)}\] PASSED", done.stdout), name
