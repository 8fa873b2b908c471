"""Train and measure a row of a study in pieces."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerf_core.common.device import pick_device
from nerf_core.common.errors import UserError
from nerf_core.common.language import phrase
from nerf_core.common.pieces import mapped
from nerf_core.common.text import duration
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.lab.records import Advance, Look, Result
from nerf_core.lab.study import Bench, Subject
from nerf_core.methods import METHODS
from nerf_core.rendering.images import rendering, to_bytes
from nerf_core.rendering.video import write_png
from nerf_core.training import checkpoint
from nerf_core.training.eval_pictures import picture_names
from nerf_core.training.evaluate import Selection, evaluating
from nerf_core.training.loop import Goal
from nerf_core.training.metrics import Lpips
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Diverged, Trainer, psnr_of

SAVE_SECONDS = 30.0  # of training between checkpoints of a row, which is what an interruption can cost
LOOK_SECONDS = 8.0  # of training between pictures of a row under way
LOOK_SIDE = 160  # pixels: pictures of a row under way have at most this side
MEASURED = 0.15  # the part of a row's work that its evaluation is taken for, until it is known


def trained(
    subject: Subject, bench: Bench, settings: RunSettings, goal: Goal, view: int
) -> Generator[Advance, None, Trainer]:
    """Train a row in its own run folder up to a goal, and return the trainer.

    What an earlier, interrupted try has saved there is continued. Yields after every step.

    Args:
        subject: the scene.
        bench: where to train.
        settings: method, preset, constants and seed.
        goal: when training ends.
        view: the index of the view that is drawn now and then, for whoever watches.

    Raises:
        UserError: the settings do not fit the scene, the loss diverged, or the folder cannot be written.
    """
    run, scene = RunFolder(bench.run), subject.capture()
    settings = replace(settings, load=subject.load, device=subject.device, threads=subject.threads)
    with run.claimed():
        if run.checkpoints():
            path, description, state, _ = checkpoint.newest(run.path)
            _must_be(path, description, scene, settings)
            with checkpoint.named(path):
                trainer = Trainer.resume(scene, description, state, subject.device)
        else:
            trainer = Trainer(scene, settings)
            run.begin(subject.data, settings, trainer)
        saved = looked = trainer.seconds
        camera = _small(scene.views[view].camera)
        name = trainer.method_name
        wanted = Goal(min(goal.steps, trainer.total_steps), goal.seconds)  # beyond its schedule no method is trained
        try:
            while not wanted.reached(trainer):
                if torch.get_num_threads() != trainer.threads:  # another model in this process may have its own
                    torch.set_num_threads(trainer.threads)
                report = trainer.step(bench.tick)
                share = max(trainer.step_count / wanted.steps, trainer.seconds / wanted.seconds)
                looks: tuple[Look, ...] = ()
                share = min(share, 1.0) * (1 - MEASURED)
                if bench.watched and trainer.seconds - looked >= LOOK_SECONDS:
                    looked = trainer.seconds
                    work = rendering(trainer.method, camera, scene)
                    color, _ = yield from mapped(work, lambda _, share=share: Advance(share))
                    looks = (Look(name, to_bytes(color), duration(trainer.seconds)),)
                text = phrase(
                    "step {step:,}, {psnr:.1f} dB in training", step=trainer.step_count, psnr=psnr_of(report.loss)
                )
                yield Advance(share, text, looks)
                if trainer.seconds - saved >= SAVE_SECONDS:
                    saved = trainer.seconds
                    _save(run, trainer)
        except GeneratorExit:  # cancelled between two steps
            _save(run, trainer)
            raise
        _save(run, trainer)
    return trainer


def _must_be(path: Path, description: Mapping[str, Any], scene: Scene, settings: RunSettings) -> None:
    """Check that a checkpoint is of this scene, method, configuration and seed. Raises UserError."""
    method = METHODS.get(settings.method)
    config = method.configure(scene, settings.preset, settings.changes, pick_device(settings.device))
    wanted = {"method": settings.method, "seed": settings.seed, "config": config.to_json()}
    stored = description.get("config")
    if description.get("method") == settings.method and isinstance(stored, Mapping):
        with suppress(UserError):  # then it is not the wanted one
            stored = method.restore(stored).to_json()  # an earlier version's lacks constants that are new
    description = {**description, "config": stored}
    odd = [name for name, value in wanted.items() if description.get(name) != value]
    if not scene.is_of(description):
        odd.insert(0, "scene")
    if odd:
        raise UserError(f"{path}: of another {' and '.join(odd)} than this row: delete {path.parent.parent}")


def _save(run: RunFolder, trainer: Trainer) -> None:
    """Write a checkpoint. Raises UserError for weights that are not finite: a row must not go on from them."""
    if not all(torch.isfinite(p).all() for p in trainer.method.parameters()):
        raise Diverged(f"step {trainer.step_count:,}: the weights are not finite; {trainer.advice}")
    run.save(trainer.describe(), trainer.state())


def measured(
    trainer: Trainer, bench: Bench, selection: Selection, lpips: Lpips | None = None
) -> Generator[Advance, None, Result]:
    """Compare a trained row with held-out photos, and keep its pictures. Yields after every tile.

    Returns:
        psnr, ssim and lpips (None: not computed), averaged over the views; `seconds`, `steps` and `threads` of
        training; `bytes` of the model's parameters; and `images` with name and metrics of each view.
    """
    newest: list[Look] = []

    names = [view.name for view in trainer.scene.views]
    files = picture_names(names)

    def keep(index: int, color: np.ndarray, truth: np.ndarray, psnr: float) -> None:
        name = names[index]
        write_png(bench.pictures / files[name], to_bytes(color))
        every = max(1, max(color.shape) // LOOK_SIDE)
        newest[:] = [
            Look(
                trainer.method_name,
                to_bytes(color[::every, ::every]),
                phrase("{psnr:.1f} dB, {name}", psnr=psnr, name=name),
            )
        ]

    def advance(piece: tuple[int, float]) -> Advance:
        done, fraction = piece
        text = phrase("measured {done} of {total} views", done=done, total=len(selection.views))
        return Advance(1 - MEASURED * (1 - fraction), text, tuple(newest))

    metrics = yield from mapped(evaluating(trainer, selection, lpips, keep), advance)
    yield advance((len(selection.views), 1.0))  # with the last picture
    kept: dict[str, Any] = {
        **metrics["mean"],
        "seconds": trainer.seconds,
        "steps": trainer.step_count,
        "threads": trainer.threads,
        "bytes": sum(p.numel() * p.element_size() for p in trainer.method.parameters()),
        "images": metrics["images"],
    }
    return kept


def _small(camera: Camera) -> Camera:
    return camera.shrunk(max(1, max(camera.width, camera.height) // LOOK_SIDE))
