"""A package outside of this repository adds a dataset format and a method (examples/plugin)."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerf_core.datasets import LoadOptions, load_scene

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables with which Python finds the installed package."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("needs setuptools, which the test extra installs")
    target = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "plugin"
    shutil.copytree(ROOT / "examples" / "plugin", source)  # the build writes into its folder
    words = ["install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(target), str(source)]
    subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *words], check=True)
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(target), str(ROOT)])}


COMMANDS = """
import json, sys
from nerf_core.cli import main
for words in json.loads(sys.argv[1]):
    assert main(words) == 0, words
"""


def test_a_plugin_is_listed_and_used(environment: dict[str, str], tmp_path: Path) -> None:
    demo, photos = load_scene(None, LoadOptions(downscale=10)), tmp_path / "photos"
    photos.mkdir()
    lines = []
    for k, view in enumerate(demo.views[:9]):
        Image.fromarray((demo.images[k] >> 8).astype(np.uint8)).save(photos / f"{k}.png")
        lines.append(" ".join([f"{k}.png", f"{view.camera.fx!r}", *map(repr, view.camera.c2w.ravel().tolist())]))
    (photos / "poses.txt").write_text("\n".join(lines).replace("np.float64(", "").replace(")", ""), encoding="utf-8")

    commands = [
        ["methods"],
        ["train", str(photos), "--method", "mean-colour", "--steps", "2", "--out", "run"],
        ["eval", "run"],
    ]
    command = [sys.executable, "-c", COMMANDS, json.dumps(commands)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "mean-colour One colour for all pixels" in " ".join(done.stdout.split())
    assert "training mean-colour on photos (7 photos)" in done.stdout
    assert "finished: step 2" in done.stdout
    assert "PSNR" in done.stdout.partition("finished: step 2")[2]
