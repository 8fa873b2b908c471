"""Find the poses of a capture's photos anew, and compare them with those that it comes with.

    python tests/benchmarks/poses.py CAPTURE [--quality normal] [--budget 60] [--downscale 4]

Prints how many photos were placed, the time of each stage, and after the best similarity transform (Umeyama, PAMI 1991)
the errors of rotations in degrees and of positions in percent of the cameras' spread. With --budget, a model is trained
on either poses for so many seconds, on the same photos, with every 8th held out, and their PSNR is compared.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerf_core.captures.posing import PoseOptions, find_poses
from nerf_core.captures.raw_photos import RawPhotos
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.capture import DATASETS
from nerf_core.datasets.recognise import recognise
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The scale, rotation (3, 3) and shift that bring points (N, 3) nearest to others, in the least-squares sense."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, sizes, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((sizes * sign).sum() / (a**2).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def errors(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees (N,), and percent of the cameras' spread (N,), between poses (N, 3, 4) after alignment."""
    scale, rotation, shift = similarity(found[:, :, 3], given[:, :, 3])
    turned = np.einsum("ij,njk->nik", rotation, found[:, :, :3])
    cosine = (np.einsum("nij,nij->n", turned, given[:, :, :3]) - 1) / 2
    moved = scale * found[:, :, 3] @ rotation.T + shift - given[:, :, 3]
    spread = np.linalg.norm(given[:, :, 3] - given[:, :, 3].mean(0), axis=1).mean()
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), 100 * np.linalg.norm(moved, axis=1) / spread


def psnr(path: Path, downscale: int, seconds: float) -> float:
    """The mean PSNR of every 8th photo, by name, after so many seconds of training on the others."""
    scene = load_scene(path, LoadOptions(downscale=downscale))
    order = sorted(range(len(scene.views)), key=lambda i: Path(scene.views[i].name).stem)
    held = set(order[::8])
    scene = replace(scene, splits={"train": tuple(sorted(set(order) - held)), "test": tuple(sorted(held))})
    trainer = Trainer(scene, RunSettings())
    while trainer.seconds < seconds:
        trainer.step()
    return evaluate(trainer, select(scene, "test"))["mean"]["psnr"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--quality", default="normal")
    parser.add_argument("--budget", type=float, default=0.0)
    parser.add_argument("--downscale", type=int, default=4)
    args = parser.parse_args()
    source, name, _ = recognise(args.capture, "auto")
    given = DATASETS.get(name).read(source, LoadOptions())
    photos = {photo.path.resolve(): np.asarray(photo.camera.c2w) for photo in given.photos}
    root = Path(next(iter(photos))).parent
    with tempfile.TemporaryDirectory() as folder:
        stages, begun = dict[str, float](), time.monotonic()
        raw = RawPhotos(root, root, tuple(sorted(photos)))
        out = Path(folder) / "posed"
        posed = find_poses(
            raw, out, PoseOptions(quality=args.quality), lambda p: stages.update({p.stage: time.monotonic() - begun})
        )
        print(f"{args.capture}: {len(posed.names) - len(posed.unplaced)} of {len(posed.names)} placed, "
              f"{posed.error:.2f} pixels, {posed.seconds:.0f} s; stages ended at "
              + ", ".join(f"{words} {s:.0f} s" for words, s in stages.items()))  # fmt: skip
        new = {
            p.path.resolve(): np.asarray(p.camera.c2w) for p in DATASETS.get("colmap").read(out, LoadOptions()).photos
        }
        both = sorted(photos.keys() & new.keys())
        turned, moved = errors(np.stack([new[k] for k in both]), np.stack([photos[k] for k in both]))
        print(f"rotation median {np.median(turned):.3f}°, largest {turned.max():.3f}°; "
              f"position median {np.median(moved):.2f} %, largest {moved.max():.2f} %")  # fmt: skip
        if args.budget:
            for words, path in (("given poses", args.capture), ("found poses", out)):
                print(f"{words}: {psnr(path, args.downscale, args.budget):.2f} dB held out after {args.budget:.0f} s")


if __name__ == "__main__":
    main()
