"""Does learning exposures help on real photos? Trains a capture with and without, and measures held-out photos.

    python tests/benchmarks/exposure.py CAPTURE… --downscale 4 --seconds 75

Each capture trains twice for the same time. Held-out photos have exposures of their own, which no model knows: "right"
is the PSNR of their right halves after a gain and an offset per channel were fitted to their left halves, "whole" that
of whole photos without a fit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from nerf_core.common.names import printable
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.rendering.images import render_camera
from nerf_core.training.metrics import psnr, psnr_matched
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def trained(scene: Scene, method: str, exposure: str, seconds: float, steps: int) -> Trainer:
    trainer = Trainer(scene, RunSettings(method=method, exposure=exposure))
    while trainer.seconds < seconds and trainer.step_count < (steps or trainer.total_steps):
        trainer.step()
    return trainer


def measured(trainer: Trainer, scene: Scene) -> tuple[float, float]:
    """The mean PSNR of right halves and of whole photos, in dB."""
    found = []
    for view in scene.held_out()[1]:
        color = render_camera(trainer.method, scene.views[view].camera, scene)[0]
        truth = scene.images[view].astype(np.float32) / 65535
        mask = scene.photos.mask(view)
        found.append((psnr_matched(color, truth, mask), psnr(color, truth, mask)))
    right, whole = np.mean(found, 0)
    return float(right), float(whole)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--method", default="voxels")
    parser.add_argument("--downscale", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=75.0)
    parser.add_argument("--steps", type=int, default=0, help="end at this step, if that comes first")
    args = parser.parse_args()
    for path in args.captures:
        scene = load_scene(path, LoadOptions(downscale=args.downscale))
        for exposure in ("off", "on"):
            trainer = trained(scene, args.method, exposure, args.seconds, args.steps)
            right, whole = measured(trainer, scene)
            line = f"{printable(path.name)} {exposure}: right {right:.2f} dB, whole {whole:.2f} dB, "
            line += f"step {trainer.step_count}, {trainer.seconds:.0f} s"
            if trainer.exposure is not None:
                gains = trainer.exposure.gains
                line += f", gains {float(gains.min()):.3f} to {float(gains.max()):.3f}"
            print(line, flush=True)


if __name__ == "__main__":
    main()
