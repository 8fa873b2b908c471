"""Train the field of own_field_as_a_method.py on the demo scene.

    python examples/train_own_field.py

It prints the verdict on a pixel, and writes the pixel's figure. The verdict is fog: nothing in this plain field makes
its layers thin.
"""

from __future__ import annotations

from pathlib import Path

import own_field_as_a_method  # it lies beside this file

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.methods import METHODS
from nerf_core.probe import open_pixel, write_inspection
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def main(out: Path = Path("runs/example"), steps: int = 300, downscale: int = 2, cells: int = 64) -> Trainer:
    """Train, open a pixel, and write its figure `own-field.svg` into the folder `out`; returns the trainer."""
    name = METHODS.name_of(own_field_as_a_method.GridMethod)
    scene = load_scene(None, LoadOptions(downscale=downscale))
    trainer = Trainer(scene, RunSettings(method=name, changes={"cells": str(cells)}))
    for _ in range(steps):
        report = trainer.step()
        if report.step % 50 == 0:
            print(f"step {report.step}: {report.psnr:.2f} dB on the training rays")
    camera = scene.views[scene.split("test")[0]].camera
    pixel = (int(0.68 * camera.width), int(0.6 * camera.height))  # column, row: on the blue ball
    opened = open_pixel(trainer.method, scene, camera, pixel, trainer.step_count)
    assert opened.verdict is not None
    print(f"{opened.verdict.kind}: {'; '.join(opened.verdict.reasons)}")
    write_inspection([opened], out / "own-field.svg")
    return trainer


if __name__ == "__main__":
    main()
