"""Measure how close a trained model comes to photos that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.pieces import finished, mapped
from nerf_core.geometry.scene import SPLITS, Scene
from nerf_core.rendering.images import rendering
from nerf_core.rendering.video import write_png
from nerf_core.training.eval_pictures import picture_names, side_by_side
from nerf_core.training.metrics import Lpips, psnr, psnr_matched, ssim
from nerf_core.training.pose_records import OUTCOMES
from nerf_core.training.pose_refinement import fitted
from nerf_core.training.trainer import Trainer

EVERY = 8  # a capture without held-out photos is measured on every 8th training photo
PERFECT_PSNR = 100.0  # dB: stands for an identical picture, because JSON has no infinity


@dataclass(frozen=True)
class Selection:
    """The photos to compare with.

    split: the split that they belong to.
    views: indices into `Scene.views`.
    subset: how they were chosen, in words; None if they are the whole split.
    """

    split: str
    views: tuple[int, ...]
    subset: str | None = None


def select(scene: Scene, split: str | None = None, count: int | None = None) -> Selection:
    """Choose the photos to compare with.

    Args:
        scene: the scene.
        split: "train", "val" or "test"; None takes test, else val, else every 8th photo of train.
        count: at most so many of them, evenly spread; None takes all.

    Raises:
        UserError: the capture does not have the split, or `count` is under 1.
    """
    name, views = (split, scene.split(split)) if split else scene.held_out()
    notes = []
    if split and not views:
        has = ", ".join(f"{s} ({len(scene.split(s))})" for s in SPLITS if scene.split(s))
        raise UserError(f"--split {shorten(split)}: {scene.name} has no such photos, but {has}")
    if not views:
        name, whole = "train", scene.split("train")
        views = whole[::EVERY]
        notes.append(f"every {EVERY}th photo: {len(views)} of {len(whole)}")
    if count is not None:
        if count < 1:
            raise UserError(f"--views {count}: give a whole number from 1 up")
        if count < len(views):
            notes.append(f"{count} of {len(views)} photos, evenly spread")
            views = tuple(views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int))
    return Selection(name, views, "; ".join(notes) or None)


def evaluate(
    trainer: Trainer,
    selection: Selection,
    *,
    lpips: Lpips | None = None,
    pictures: Path | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> dict[str, Any]:
    """Render the selected views and compare them with their photos.

    Metrics are computed from float colours in [0, 1] and averaged over the images. Masked pixels are not counted: PSNR
    leaves them out, SSIM every window that has one, and for LPIPS they are the photo's own.

    Args:
        trainer: the trained model with its scene.
        selection: the photos.
        lpips: computes LPIPS; without it, "lpips" is null.
        pictures: a folder for pictures that show photo, rendering and error side by side.
        progress: called after every tile with the number of finished images and the fraction of all work; it may raise
            to cancel.

    Returns:
        What `nerf-core eval` writes to metrics.json, as finite JSON values: "mean" and "images" with psnr (dB), ssim
        and lpips, and "split", "method", "step", "seconds" and "subset". An image
        with a mask has its masked share, "masked". If exposures are learnt, "exposure" has those of the training
        photos, and images have "psnr_matched"; see `psnr_matched`. If poses are corrected, "poses" has by how much each
        training photo was turned (degrees) and shifted (percent of the scene's radius), and images have "psnr_posed":
        of the right half, from the pose that fits the left half best. A training photo has its corrected pose.

    Raises:
        UserError: the images are too small for a metric, or the folder cannot be written.
    """

    views, photos = trainer.scene.views, trainer.scene.photos
    files = picture_names([view.name for view in views])

    def keep(index: int, color: np.ndarray, truth: np.ndarray, found: float) -> None:
        if pictures is not None:
            sheet = side_by_side(color, truth, photos.mask(index), found)
            write_png(pictures / files[views[index].name], sheet)

    def tell(piece: tuple[int, float]) -> None:
        if progress is not None:
            progress(*piece)

    return finished(evaluating(trainer, selection, lpips, keep), tell)


def evaluating(
    trainer: Trainer,
    selection: Selection,
    lpips: Lpips | None,
    keep: Callable[[int, np.ndarray, np.ndarray, float], None],
) -> Generator[tuple[int, float], None, dict[str, Any]]:
    """Do what `evaluate` does in pieces. Yields after every tile the finished images and the fraction of all work.

    Args:
        trainer, selection, lpips: see `evaluate`.
        keep: called with the index of each view, its rendering and its photo, (H, W, 3) float32 in [0, 1] each, and the
            PSNR in dB.
    """
    images: list[dict[str, Any]] = []
    count = len(selection.views)
    first = 1.0 if trainer.refinement is None else 0.5  # the share of an image's work that its first rendering is
    for index in selection.views:
        view = trainer.scene.views[index]
        truth = trainer.scene.images[index].astype(np.float32) / 65535
        if trainer.scene.photos.damaged(index):  # found only now, because it was read only now
            continue
        work, done = rendering(trainer.method, view.camera, trainer.scene), len(images)
        color, _ = yield from mapped(work, lambda share, done=done: (done, (done + first * share) / count))
        mask = trainer.scene.photos.mask(index)
        shown = color if mask is None else np.where(mask[..., None], color, truth)
        images.append(
            {
                "name": view.name,
                "psnr": min(psnr(color, truth, mask), PERFECT_PSNR),
                "ssim": ssim(color, truth, mask),
                "lpips": None if lpips is None else lpips(shown, truth),
            }
            | ({} if mask is None else {"masked": float(1 - mask.mean())})
            | _matched(trainer, color, truth, mask)
            | (
                yield from mapped(
                    _posed(trainer, index, color), lambda share, done=done: (done, (done + share) / count)
                )
            )
        )
        keep(index, color, truth, images[-1]["psnr"])
    names = ["psnr", "ssim", "lpips"]
    names += [] if trainer.exposure is None else ["psnr_matched"]
    names += [] if trainer.refinement is None else ["psnr_posed"]
    result: dict[str, Any] = {
        "mean": {name: _mean([image[name] for image in images]) for name in names},
        "images": images,
        "split": selection.split,
        "method": trainer.method_name,
        "step": trainer.step_count,
        "seconds": trainer.seconds,
    }
    if selection.subset is not None:
        result["subset"] = selection.subset
    if trainer.exposure is not None:
        result["exposure"] = exposures(trainer)
    if trainer.refinement is not None:
        result["poses"] = poses(trainer)
    return result


def _posed(trainer: Trainer, index: int, color: np.ndarray) -> Generator[float, None, dict[str, Any]]:
    """The PSNR of the right half from a pose that was fitted to the left half, if poses are corrected.

    color: (H, W, 3) what the model shows from the pose that the photo has. Yields the share of the image's work that is
    done.
    """
    if trainer.refinement is None:
        return {}
    if index not in trainer.refinement.views:  # those have a pose already
        there = trainer.scene.reposed({index: fitted(trainer.method, trainer.scene, index)})
        work = rendering(trainer.method, there.views[index].camera, there)
        color, _ = yield from mapped(work, lambda share: (1 + share) / 2)
    truth, mask = trainer.scene.images[index].astype(np.float32) / 65535, trainer.scene.photos.mask(index)
    half = color.shape[1] // 2
    right = None if mask is None else mask[:, half:]
    if right is not None and not right.any():
        return {"psnr_posed": None}
    return {"psnr_posed": min(psnr(color[:, half:], truth[:, half:], right), PERFECT_PSNR)}


def poses(trainer: Trainer) -> list[dict[str, Any]]:
    """Return name, turn, shift and last outcome of each training photo; empty if poses are not corrected."""
    found = trainer.corrections
    if found is None:
        return []
    rows = zip(found.views.tolist(), found.turned.tolist(), found.shifted.tolist(), found.outcome.tolist(), strict=True)
    return [
        {"name": trainer.scene.views[i].name, "degrees": turn, "percent": 100 * shift, "outcome": OUTCOMES[outcome]}
        for i, turn, shift, outcome in rows
    ]


def _matched(trainer: Trainer, color: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> dict[str, Any]:
    """The PSNR of the right half once the left one's exposure is matched, if training photos have exposures."""
    if trainer.exposure is None:
        return {}
    found = psnr_matched(color, truth, mask)
    return {"psnr_matched": None if found is None else min(found, PERFECT_PSNR)}


def exposures(trainer: Trainer) -> list[dict[str, Any]]:
    """Return name, gains and offsets (red, green, blue) of each training photo; empty if they are not learnt."""
    learnt = trainer.exposure
    if learnt is None:
        return []
    rows = zip(learnt.views, learnt.gains.tolist(), learnt.offsets.tolist(), strict=True)
    return [{"name": trainer.scene.views[i].name, "gain": gain, "offset": offset} for i, gain, offset in rows]


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None
