"""The worked examples of docs/extending.md: each file is taken from the page, loaded, and used."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pages
import pytest
from PIL import Image

from nerf_core.cli import main
from nerf_core.commands import COMMANDS
from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.capture import DATASETS
from nerf_core.geometry.cameras import camera_rays
from nerf_core.rendering.modes import MODES, mode_names, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

ROOT = Path(__file__).parent.parent
SMALL_NERF = {"width": "16", "coarse_samples": "8", "fine_samples": "8"}
Load = Callable[[str, Registry[Any]], ModuleType]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Load:
    return pages.loader(monkeypatch)


def test_every_file_of_the_page_is_tested() -> None:
    tests = [Path(__file__), ROOT / "tests" / "viewer" / "test_extending.py"]
    told = "".join(test.read_text(encoding="utf-8") for test in tests)
    assert pages.files()
    assert [path for path in pages.files() if f'load("{path}"' not in told] == []


@pytest.mark.parametrize("path", pages.files())
def test_a_file_of_the_page_would_be_new(path: str) -> None:
    assert (ROOT / path).parent.is_dir()
    assert not (ROOT / path).exists()


def test_a_dataset_format(load: Load, tmp_path: Path) -> None:
    load("nerf_core/datasets/formats/csv_poses.py", DATASETS)
    demo = load_scene(None, LoadOptions(downscale=8))
    with (tmp_path / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        for k, view in enumerate(demo.views[:9]):
            Image.fromarray((demo.images[k] >> 8).astype(np.uint8)).save(tmp_path / f"{k}.png")
            csv.writer(file).writerow([f"{k}.png", view.camera.fx, *view.camera.c2w.ravel()])
    scene = load_scene(tmp_path, LoadOptions())
    assert scene.format == "csv"
    assert [view.name for view in scene.views] == [f"{k}.png" for k in range(9)]
    assert scene.views[3].camera.fx == demo.views[3].camera.fx
    (tmp_path / "poses.csv").write_text("0.png,20,1,2,3\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"poses\.csv: line 1"):
        load_scene(tmp_path, LoadOptions())


def test_a_render_mode(load: Load) -> None:
    load("nerf_core/rendering/modes/opacity.py", MODES)
    assert mode_names()[-1] == "opacity"
    scene = load_scene(None, LoadOptions(downscale=20))
    method = Trainer(scene, RunSettings(method="nerf", changes=SMALL_NERF)).method
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    trace = method.trace(rays)
    picture = shaded(method, rays, trace, "opacity")
    assert picture.shape == (len(rays), 3)
    assert MODES.get("opacity").values(method, rays, trace).shape == (len(rays),)


def test_a_subcommand(load: Load, capsys: pytest.CaptureFixture[str]) -> None:
    load("nerf_core/commands/photos.py", COMMANDS)
    assert main(["photos"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 90
    assert lines[0] == "train\ttrain/r_0.png\t200 × 200"
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "List the photos of a capture by split." in capsys.readouterr().out
