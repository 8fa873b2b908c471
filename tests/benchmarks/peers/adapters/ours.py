"""This project: `nerf-core train` in a process of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from nerf_core.rendering.images import render_camera
from nerf_core.training.run_folder import RunFolder

NAME, UNIT, FIRST = "ours", "steps", 300
OPTION, HELP = "method", "method of this project, as in nerf-core train --method (default: auto)"


def missing(given: str) -> str:
    """It is always there."""
    return ""


def command(photos: Path, folder: Path, amount: float, given: str) -> list[str]:
    """Train for `amount` steps. A number of seconds would be another number of steps on a busy machine."""
    whole = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
    train = [sys.executable, "-m", "nerf_core.cli", "train", str(photos), "--out", str(folder / "run")]
    train += ["--format", "blender" if whole["synthetic"] else "transforms", "--ndc", "on" if whole["ndc"] else "auto"]
    train += ["--background", "white" if min(whole["background"]) == 1 else "black", "--device", "cpu"]
    return [*train, "--method", given or "auto", "--steps", str(max(1, round(amount))), "--save-every", "100000"]


def render(photos: Path, folder: Path, given: str) -> list[np.ndarray]:
    """Draw the held-out views, float (H, W, 3) in [0, 1], in the order of test_filenames."""
    trainer, _ = RunFolder(folder / "run").restore(on="cpu")
    scene = trainer.scene
    return [render_camera(trainer.method, scene.views[i].camera, scene)[0] for i in scene.split("test")]
