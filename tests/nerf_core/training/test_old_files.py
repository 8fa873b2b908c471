"""Runs and checkpoints from before the modules moved into packages still load and continue."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.live.pin_files import restored_pins, with_histories
from nerf_core.training import checkpoint
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Trainer
from nerf_core.volume.voxel_grid import blocks_of, vertices_of

FILES = Path(__file__).parents[2] / "fixtures" / "before_packages"
METHODS = ("voxels", "hash", "nerf", "nerf-guided")


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene(None, LoadOptions(max_size=16))


@pytest.mark.parametrize("method", METHODS)
def test_an_old_run_continues(method: str, demo: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerf_core.training.run_folder.open_capture", lambda *_: demo)  # loaded once for all methods
    run = RunFolder(shutil.copytree(FILES / method, tmp_path / method))
    trainer, _ = run.restore()
    assert (trainer.method_name, trainer.step_count, trainer.seed) == (method, 12, 3)
    stored = checkpoint.newest(run.path)[2]
    state = trainer.state()
    # pixels were drawn with replacement; the key of their order comes from the generator
    assert state["batches.order"][1] == 0
    for name in ("batches.order", "batches.generator"):
        stored[name] = state[name]
    # voxel grids had cells of one size, rows for whole bricks and first moments, and marked what random rays had seen
    for name in list(stored):
        if name.endswith("grid.occupied"):
            grid = name.removesuffix("occupied")
            occupied, bricks = stored.pop(name), stored.pop(f"{grid}bricks")
            stored |= {f"{grid}kinds": occupied.to(torch.uint8), f"{grid}sizes": torch.tensor(1)}
            used = blocks_of(vertices_of(occupied), 2)[bricks].flatten()
            for one in (f"{grid}rows", f"{grid.removesuffix('grid.')}average", f"{grid.removesuffix('grid.')}moments"):
                if one in stored:
                    stored[one] = stored[one][used]
        elif name.endswith("seen"):
            error = name.replace("seen", "error")
            stored[error] = torch.zeros_like(state[error])
            stored[name.replace("seen", "full")] = torch.tensor(False)
            del stored[name]
        elif name.endswith(".moments") and method == "voxels":
            stored[name] = stored[name][:, [14, 15, 13]]
    assert set(state) == set(stored)
    assert all(torch.equal(value.cpu(), stored[name]) for name, value in state.items())
    assert trainer.step().step == 13


def test_an_old_run_is_read_with_its_own_scene(tmp_path: Path) -> None:
    run = RunFolder(shutil.copytree(FILES / "voxels", tmp_path / "voxels"))
    data, settings = run.config()
    assert data is None
    assert settings.load == LoadOptions(max_size=16)
    assert settings.changes == {"start": "4", "resolution": "4"}


def test_an_old_window_checkpoint_brings_its_pins_back(demo: Scene) -> None:
    description, state = checkpoint.load(FILES / "window.safetensors")
    assert Trainer.resume(demo, description, state).step_count == 12
    pins = with_histories(restored_pins(description), description, state)
    assert [pin.name for pin in pins][3:] == ["ray 4", "ray 5"]  # after the demo scene's own three
    for pin in pins:
        assert pin.history is not None
        assert pin.history.steps[-1] == 12
