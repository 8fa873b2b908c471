"""Do wrong poses come back? Trains a capture on disturbed poses, with and without `--refine-poses`.

    python tests/benchmarks/refine_poses.py CAPTURE… demo --downscale 4 --steps 600

The pose of every photo, or of --photos training photos, is turned by --degrees about a random axis and shifted in a
random direction by --percent of the camera's distance from the scene's centre. Errors are those of disturbed training
cameras, after the similarity (turn, shift
and scaling) that brings them closest to the true ones: median and RMS, of turns in degrees, of places in
percent of that distance. Held-out photos are seen from their true poses, brought into the frame of the refined cameras
by the similarity the other way round: no pose is fitted to them. "undisturbed" trains on the capture's own poses.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.rendering.images import render_camera
from nerf_core.training.metrics import psnr
from nerf_core.training.pose_fit import rotation, turn_of
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def chosen(scene: Scene, photos: int) -> list[int]:
    """Return so many training photos, evenly spread; 0: all photos of all splits."""
    return list(scene.trained(photos)) if photos else list(range(len(scene.views)))


def disturbed(scene: Scene, degrees: float, percent: float, seed: int, photos: int) -> Scene:
    """Return the scene with poses turned and shifted at random."""
    rng, poses = np.random.default_rng(seed), {}
    for i in chosen(scene, photos):
        view = scene.views[i]
        axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        c2w, reach = view.camera.c2w, np.linalg.norm(view.camera.c2w[:, 3] - scene.center)
        shifted = c2w[:, 3] + percent / 100 * reach * way
        poses[i] = np.column_stack([rotation(np.radians(degrees) * axis) @ c2w[:, :3], shifted])
    return scene.reposed(poses)


def similarity(poses: np.ndarray, onto: np.ndarray, center: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return scale s, rotation R and shift t so that s R x + t takes poses (N, 3, 4) closest to others.

    It is Umeyama's (1991). The cameras' axes count as three more points each, as far away as the scene's centre: the
    places of a forward-facing capture alone hardly tell the rotation.
    """
    a, b = (p[:, :, 3] - p[:, :, 3].mean(0) for p in (poses, onto))
    reach = np.linalg.norm(onto[:, :, 3] - center, axis=-1).mean()
    axes = (onto[:, :, :3] @ np.swapaxes(poses[:, :, :3], 1, 2)).sum(0)
    u, _, vt = np.linalg.svd(b.T @ a + reach**2 * axes)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = float((b * (a @ turn.T)).sum() / (a**2).sum())
    return scale, turn, onto[:, :, 3].mean(0) - scale * turn @ poses[:, :, 3].mean(0)


def errors(scene: Scene, truth: Scene, photos: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of disturbed training cameras, in degrees and in percent of their distance from the centre."""
    views = list(truth.split("train"))
    asked = np.isin(views, chosen(truth, photos))
    ours, true = scene.poses[views], truth.poses[views]
    scale, turn, shift = similarity(ours, true, truth.center)
    turned = np.linalg.norm(turn_of(np.swapaxes(true[:, :, :3], 1, 2) @ turn @ ours[:, :, :3]), axis=-1)
    away = np.linalg.norm(scale * ours[:, :, 3] @ turn.T + shift - true[:, :, 3], axis=-1)
    share = away / np.linalg.norm(true[:, :, 3] - truth.center, axis=-1)
    return np.degrees(turned)[asked], 100 * share[asked]


def held_out(trainer: Trainer, truth: Scene) -> float:
    """Return the mean PSNR of held-out photos from their true poses, in the frame of the trainer's cameras, in dB."""
    views = list(truth.split("train"))
    scale, turn, shift = similarity(truth.poses[views], trainer.scene.poses[views], truth.center)
    found = []
    for view in truth.held_out()[1]:
        c2w = truth.views[view].camera.c2w
        pose = np.column_stack([turn @ c2w[:, :3], scale * turn @ c2w[:, 3] + shift])
        there = trainer.scene.reposed({view: pose})
        color = render_camera(trainer.method, there.views[view].camera, there)[0]
        found.append(psnr(color, truth.images[view].astype(np.float32) / 65535, truth.photos.mask(view)))
    return float(np.mean(found))


def said(turned: np.ndarray, away: np.ndarray) -> str:
    values = np.median(turned), np.sqrt((turned**2).mean()), np.median(away), np.sqrt((away**2).mean())
    return "turn {:.3f}° (RMS {:.3f}°), place {:.3f} % (RMS {:.3f} %)".format(*values)


def runs(scene: Scene, args: argparse.Namespace) -> Iterator[tuple[str, Scene, bool]]:
    wrong = disturbed(scene, args.degrees, args.percent, args.seed, args.photos)
    for name, given in (("disturbed", wrong), ("undisturbed", scene)):
        for refine in (True, False):
            if name in args.only and (refine or not args.refined_only):
                yield f"{name}, {'refined' if refine else 'as they are'}", given, refine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", help="a folder, or demo")
    parser.add_argument("--method", default="voxels")
    parser.add_argument("--downscale", type=int, default=8)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--degrees", type=float, default=1.0)
    parser.add_argument("--percent", type=float, default=1.0)
    parser.add_argument("--photos", type=int, default=0, help="how many training photos are disturbed; 0: all photos")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=["disturbed", "undisturbed"])
    parser.add_argument("--refined-only", action="store_true")
    parser.add_argument("--every", type=int, default=0, help="say the errors every so many steps")
    parser.add_argument("--set", nargs="*", default=[], help="NAME=VALUE: constants of the method")
    args = parser.parse_args()
    for path in args.captures:
        scene = load_scene(None if path == "demo" else Path(path), LoadOptions(downscale=args.downscale))
        for name, given, refine in runs(scene, args):
            changes = dict(text.split("=") for text in args.set)
            trainer = Trainer(given, RunSettings(method=args.method, refine_poses=refine, changes=changes))
            print(f"{scene.name}, {name}: at first {said(*errors(trainer.scene, scene, args.photos))}", flush=True)
            while trainer.step_count < args.steps:
                trainer.step()
                if args.every and trainer.step_count % args.every == 0:
                    print(
                        f"  step {trainer.step_count}: {said(*errors(trainer.scene, scene, args.photos))}", flush=True
                    )
            print(
                f"{scene.name}, {name}: at step {trainer.step_count} {said(*errors(trainer.scene, scene, args.photos))}"
            )
            print(f"  held out {held_out(trainer, scene):.2f} dB, {trainer.seconds:.0f} s", flush=True)
            if trainer.corrections is not None:
                print(f"  {trainer.corrections.rounds} rounds, {trainer.corrections.summary()}", flush=True)


if __name__ == "__main__":
    main()
