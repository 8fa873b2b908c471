"""The worked examples of docs/extending.md: each file is taken from the page, loaded, and used."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pages
import panel_states
import pytest
import torch
from PIL import Image

from nerf_core.cli import main
from nerf_core.commands import COMMANDS
from nerf_core.common.configs import changed
from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.capture import DATASETS
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels.choice import VOXEL_KERNELS, voxel_kernels
from nerf_core.kernels.implementations import on_numba
from nerf_core.kernels.voxel_kernels import March
from nerf_core.lab.job import StudyJob
from nerf_core.lab.study import STUDIES, Subject
from nerf_core.live.scheduler import Scheduler
from nerf_core.live.shares import SHARES, Situation
from nerf_core.methods import Traceable
from nerf_core.probe.verdict import conclude
from nerf_core.probe.verdicts import VERDICTS
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.rendering.export.requests import ExportModel
from nerf_core.rendering.export.start import export_job
from nerf_core.rendering.modes import MODES, mode_names, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.voxel_grid import VoxelGrid

ROOT = Path(__file__).parent.parent
SMALL_NERF = {"width": "16", "coarse_samples": "8", "fine_samples": "8"}
Load = Callable[[str, Registry[Any]], ModuleType]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Load:
    return pages.loader(monkeypatch)


def test_every_file_of_the_page_is_tested() -> None:
    tests = [Path(__file__), ROOT / "tests" / "viewer" / "test_extending.py"]
    text = "".join(test.read_text(encoding="utf-8") for test in tests)
    assert pages.files()
    assert [path for path in pages.files() if f'load("{path}"' not in text] == []


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
    assert "opacity" in mode_names()
    scene = load_scene(None, LoadOptions(downscale=12))
    method = Trainer(scene, RunSettings(method="nerf", changes=SMALL_NERF)).method
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    assert isinstance(method, Traceable)
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


def test_a_camera_path(load: Load) -> None:
    load("nerf_core/geometry/paths/approach.py", PATHS)
    scene = load_scene(None, LoadOptions(downscale=8))
    cameras = PATHS.get("approach").cameras(scene, 5, 40, 30, left=0.5)
    first = scene.views[scene.split("train")[0]].camera.c2w
    distances = [float(np.linalg.norm(camera.c2w[:, 3] - scene.center)) for camera in cameras]
    np.testing.assert_allclose(cameras[0].c2w, first)
    np.testing.assert_allclose(distances, np.linspace(1, 0.5, 5) * distances[0])
    assert all((camera.width, camera.height) == (40, 30) for camera in cameras)
    with pytest.raises(UserError, match="left of 2: take a number from 0 to 1"):
        PATHS.get("approach").cameras(scene, left=2.0)


def test_a_kernel_implementation(load: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    load("nerf_core/kernels/implementations/checked.py", VOXEL_KERNELS)
    known = {name: VOXEL_KERNELS.get(name) for name in ("numba", "checked", "torch")}  # the page names these ranks
    monkeypatch.setattr(VOXEL_KERNELS, "_items", known)
    monkeypatch.setattr(on_numba, "numba_obstacle", lambda: "numba is gone")
    kernels = voxel_kernels(torch.device("cpu"))
    grid = VoxelGrid.over(np.full(3, -1.0), np.full(3, 0.5), torch.ones(4, 4, 4, dtype=torch.bool), False)
    origin, direction = torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    rays = BoxRays(origin, direction, direction, torch.zeros(1), torch.full((1,), 9.0))
    march = March(0.7, 0.0, torch.ones(3), torch.zeros(1))
    error, samples = kernels.accumulate(grid, rays, torch.zeros(1, 3), march)
    assert error > 0
    assert samples > 0
    with pytest.raises(FloatingPointError, match="1 rays"):
        kernels.accumulate(grid, rays, torch.full((1, 3), torch.nan), march)


def test_a_model_export(load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    EXPORTS.names()
    monkeypatch.setattr(EXPORTS, "_items", {})  # as if none was there
    scene = load_scene(None, LoadOptions(downscale=12))
    trainer = Trainer(scene, RunSettings(method="voxels", changes={"start": "8", "resolution": "16"}))
    for _ in range(5):
        trainer.step()
    with pytest.raises(UserError, match=r"a model is written as no model file; no model export is installed"):
        export_job(ExportModel(tmp_path / "a.ply"), trainer.method, scene)
    load("nerf_core/rendering/export/models/points.py", EXPORTS)
    with pytest.raises(UserError, match=r"a\.obj: a model is written as \.ply"):
        export_job(ExportModel(tmp_path / "a.obj"), trainer.method, scene)
    job = export_job(ExportModel(tmp_path / "a.ply"), trainer.method, scene)
    while job.advance():
        pass
    assert job.progress.done == job.progress.total
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    count = int(header.split(b"vertex ")[1].split()[0])
    assert 0 < count < len(scene.split("train")) * 100
    points = np.frombuffer(body, [("position", "<f4", 3), ("color", "u1", 3)])
    assert len(points) == count
    assert np.linalg.norm(points["position"] - scene.center, axis=-1).max() < scene.far


def test_a_verdict_class(load: Load) -> None:
    load("nerf_core/probe/verdicts/wrong_colour.py", VERDICTS)
    ray = panel_states.make_ray()
    opened = panel_states.make_opened(ray)
    assert opened.verdict is not None
    missed = replace(opened.verdict.standings[0], against=0, blank=0, missing=11)  # so that it is no floater
    assert conclude(ray, (replace(missed, error=0.2),)).kind == "wrong colour"
    assert conclude(ray, (replace(missed, error=0.02),)).kind == "surface"


def test_a_rule_for_the_share_of_time(load: Load) -> None:
    load("nerf_core/live/shares/smooth.py", SHARES)
    scheduler = Scheduler(0.5)
    scheduler.set_share(0.6, "smooth")
    scheduler.adapt(Situation(moving=True, exporting=False))
    assert scheduler.budget.share == 0.3
    scheduler.adapt(Situation(moving=False, exporting=False))
    assert scheduler.budget.share == 0.6


def test_a_study(load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load("nerf_core/lab/studies/photos.py", STUDIES)
    scene = load_scene(None, LoadOptions(downscale=10))
    kind: Any = STUDIES.get("photos")
    study = changed(kind(), {"budget": "1steps"}, "photos")
    job = StudyJob(study, Subject(None, LoadOptions(), scene, "cpu"), tmp_path)
    while job.advance():
        pass
    (table,) = job.progress.tables
    assert [row[0] for row in table.rows] == ["36", "72"]
    assert (tmp_path / "report.md").is_file()
