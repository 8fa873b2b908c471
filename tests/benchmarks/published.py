"""Measure a row of tables.py as papers report a scene: every test view, PSNR, SSIM and LPIPS, and the whole time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from measures import peak_gib

from nerf_core.geometry.scene import Scene
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.metrics import Lpips
from nerf_core.training.trainer import Trainer

VIEWS, SIZE, WHITE = 200, (800, 800), (1.0, 1.0, 1.0)  # of NeRF's synthetic scenes (Mildenhall et al. 2020)
METRICS = {"psnr": 2, "ssim": 4, "lpips": 4}  # digits to print


def protocol(scene: Scene) -> str:
    """Say how the held-out views compare with those of the published figures: all 200 at 800 × 800 on white."""
    split, views = scene.held_out()
    sizes = {(scene.views[i].camera.width, scene.views[i].camera.height) for i in views}
    wide = ", ".join(f"{width}×{height}" for width, height in sorted(sizes))
    if not scene.synthetic:
        return f"{len(views)} {split} views, {wide}; the published protocol is for NeRF's synthetic scenes"
    if split == "test" and len(views) == VIEWS and sizes == {SIZE} and scene.background == WHITE:
        return f"the published protocol: all {VIEWS} test views, {wide}, on white"
    ground = "on white" if scene.background == WHITE else "not on white"
    return f"subset of {len(views)} {split} views, {wide}, {ground}; published are all {VIEWS} at 800×800 on white"


def learn_and_evaluate(trainer: Trainer, seconds: float, started: float, weights: Path | None) -> dict[str, Any]:
    """Train for `seconds` of training steps, then compare all held-out views.

    Args:
        trainer: a new one.
        seconds: when to end.
        started: when the process started, in seconds since the epoch.
        weights: LPIPS's weights, or None.

    Returns:
        "wall": seconds from the start of the process to the end of training; imports, compiling and loading count.
        "evaluating": seconds to draw and compare the views. The means, and what `protocol` says.
    """
    while trainer.seconds < seconds:
        trainer.step()
    trained = time.time()
    device = torch.device(trainer.device)
    done = evaluate(trainer, select(trainer.scene), lpips=Lpips(weights, device) if weights else None)
    return {
        **done["mean"],
        "views": len(done["images"]),
        "protocol": protocol(trainer.scene),
        "steps": trainer.step_count,
        "seconds": trainer.seconds,
        "wall": trained - started,
        "evaluating": time.time() - trained,
        "peak_gib": peak_gib(),
    }
