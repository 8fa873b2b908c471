"""The scripts in examples/, with few steps on small photos."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.methods import METHODS
from nerf_core.training import checkpoint
from nerf_core.training.trainer import Trainer

FOLDER = Path(__file__).parent.parent / "examples"
SMALL = 8  # downscale of the demo scene's photos: 25 × 25 pixels
FEW = 20  # steps
FIELD = "own_field_as_a_method"  # a method, which a script imports


def script(name: str) -> Callable[..., Any]:
    """The function `main` of an example."""
    return runpy.run_path(str(FOLDER / f"{name}.py"))["main"]


def test_every_example_is_tested() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    scripts = [file for file in FOLDER.glob("*.py") if "def main(" in file.read_text(encoding="utf-8")]
    assert [file.name for file in scripts if f'script("{file.stem}")' not in text] == []
    assert {*FOLDER.glob("*.py")} - {*scripts} == {FOLDER / f"{FIELD}.py"}  # train_own_field.py imports it


def test_train_and_render(tmp_path: Path) -> None:
    psnr = script("train_and_render")(tmp_path, FEW, SMALL)
    assert psnr > 10  # a picture of the mean colour alone has about 12 dB
    assert (tmp_path / "rendering.png").is_file()
    assert (tmp_path / "photo.png").is_file()


def test_open_a_pixel(tmp_path: Path) -> None:
    opened = script("open_a_pixel")(tmp_path, FEW, SMALL)
    document = json.loads((tmp_path / "ray.json").read_text(encoding="utf-8"))
    assert document["step"] == FEW
    assert opened.verdict.kind == "surface"
    assert document["verdict"]["kind"] == opened.verdict.kind
    np.testing.assert_allclose(document["color"], opened.ray.color, atol=1e-6)
    assert "<svg" in (tmp_path / "ray.svg").read_text(encoding="utf-8")


def test_batch_of_figures(tmp_path: Path) -> None:
    files = script("batch_of_figures")(tmp_path, (3, FEW), SMALL)
    assert [file.name for file in files] == ["step-00003.svg", "step-00020.svg"]
    assert all(file.is_file() for file in files)
    with (tmp_path / "table.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["3", "20"]
    assert rows[-1]["verdict"] == "surface"


def test_export(tmp_path: Path) -> None:
    film, still, model = script("export")(tmp_path, FEW, SMALL, frames=3, side=32)
    assert film.stat().st_size > 0
    assert np.load(still).shape == (32, 32, 3)
    description, state = checkpoint.load(model)
    scene = load_scene(None, LoadOptions(downscale=SMALL))
    assert Trainer.resume(scene, description, state, "cpu").step_count == FEW


def test_train_own_field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    METHODS.names()  # load what is registered without the example
    others = {name: method for name, method in METHODS._items.items() if name != "grid"}
    monkeypatch.setattr(METHODS, "_items", others)  # what the example registers is removed after the test
    monkeypatch.syspath_prepend(FOLDER)  # as if the script was started by its path
    sys.modules.pop(FIELD, None)  # its import registers the method
    trainer = script("train_own_field")(tmp_path, 12, SMALL, cells=12)
    assert trainer.method_name == "grid"
    assert "layer at" in capsys.readouterr().out  # the verdict's reason: the pixel is not empty
    loss = trainer.history.view().loss
    assert loss[-1] < loss[0]
    assert "<svg" in (tmp_path / "own-field.svg").read_text(encoding="utf-8")
    again = Trainer.resume(trainer.scene, trainer.describe(), trainer.state(), "cpu")
    assert trainer.step().loss == again.step().loss  # a checkpoint holds all that the next step needs
