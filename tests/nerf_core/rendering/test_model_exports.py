"""The rules for every model export, whichever file registers it, and for the one in docs/extending.md."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pages
import pytest
import torch

from nerf_core.geometry.scene import Scene
from nerf_core.rendering.export.models import EXPORTS, export_for
from nerf_core.training.trainer import Trainer

EXAMPLE, FILE = "points", "nerf_core/rendering/export/models/points.py"  # none ships with the program


@pytest.fixture(params=sorted({EXAMPLE, *EXPORTS.names()}))
def name(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param not in EXPORTS.names():
        pages.loader(monkeypatch)(FILE, EXPORTS)
    return request.param


def test_the_suffix_chooses_the_export(name: str) -> None:
    kind = EXPORTS.get(name)
    assert kind.label
    assert kind.summary
    assert kind.suffix == kind.suffix.lower()
    assert kind.suffix.startswith(".")
    assert export_for(Path(f"model{kind.suffix.upper()}")) is kind


def test_an_export_writes_its_file_as_a_whole_and_leaves_the_model_alone(
    name: str, make_trainer: Callable[..., Trainer], scene: Scene, tmp_path: Path
) -> None:
    kind, trainer = EXPORTS.get(name), make_trainer()
    trainer.step()
    before = {key: value.clone() for key, value in trainer.state().items()}
    file = tmp_path / f"model{kind.suffix}"
    job = kind(trainer.method, scene, file)
    while job.advance():
        assert not file.exists() or job.progress.done == job.progress.total
    assert (job.progress.state, job.progress.done) == ("done", job.progress.total)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    assert file.stat().st_size > 0
    assert all(torch.equal(value, before[key]) for key, value in trainer.state().items())


def test_a_cancelled_export_leaves_no_file(
    name: str, make_trainer: Callable[..., Trainer], scene: Scene, tmp_path: Path
) -> None:
    kind = EXPORTS.get(name)
    job = kind(make_trainer().method, scene, tmp_path / f"model{kind.suffix}")
    job.advance()
    job.cancel()
    assert not job.advance()
    assert list(tmp_path.iterdir()) == []
