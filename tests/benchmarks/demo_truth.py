"""Measure how near a model trained on the demo scene comes to the truth, which is known in closed form.

    python tests/benchmarks/demo_truth.py [--seconds 300 | --steps 1000] [--downscale 1] [--twice] [--set NAME=VALUE …]

- Depth: the error of the rendered expected depth, at pixels of the test views that truly see a surface, and its median
  with the sign (bias; positive: too deep).
- Speckle: the mean absolute difference between neighbouring pixels' errors of colour on the glossy ball. Detail that
  the model lacks counts too: the truth itself, blurred with a standard deviation of one pixel, has 0.044.
- Noise (--twice): the same of the difference between the pictures of two seeds, / √2. Both lack the same detail, so
  this is the grain that training leaves in one picture.
- Radiance: the error of the colour that the model emits towards training cameras that see a point, at true surface
  points that the test views see.
- Spread: how much the emitted colour changes between those cameras, in the model and in truth, for the glossy ball and
  for the matt vase.
- Microscope: the error of its radiance plot on the glossy ball, for directions near those of photos and for the others,
  where the plot extrapolates.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rendering
from nerf_core.probe import TrainingViews
from nerf_core.probe.opened import pieces
from nerf_core.rendering.images import render_camera
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "assets"))

import demo_scene

POINTS = 400  # surface points whose radiance is compared
OBSERVED = np.radians(20)  # directions this near to a photo's are observed: the radiance plot does not hatch them
CAMERAS = 8  # training cameras per point, at most


def compare(trainer: Trainer, views: int = 3, points: int = POINTS, seed: int = 0) -> dict[str, float]:
    """Figures for the first `views` test views; lengths in scene units, colours on the [0, 1] scale of the photos."""
    scene, rng = trainer.scene, np.random.default_rng(seed)
    depth_errors, signed, speckles, hits = [], [], [], []
    for index in scene.split("test")[:views]:
        rays = camera_rays(scene.views[index].camera, scene.near, scene.far)
        rendered = Rendering.cat([trainer.method.render(rays)])
        t, normal, objects = demo_scene.hit(rays.origins.double().numpy(), rays.directions.double().numpy())
        solid = np.isfinite(t)
        signed.append(rendered.depth.numpy()[solid] - t[solid])
        error = np.abs(signed[-1])
        depth_errors.append(np.where(np.isnan(error), scene.far - scene.near, error))  # a hole has the largest error
        met = rays.origins.numpy()[solid] + t[solid, None] * rays.directions.numpy()[solid]
        hits.append((met, normal[solid], objects[solid]))
        truth = scene.images[index] / 65535
        ball = (solid & (objects == demo_scene.BALL)).reshape(truth.shape[:2])
        speckles.append(_speckle(rendered.color.numpy().reshape(truth.shape) - truth, ball))
    hit, normals, objects = (np.concatenate(v) for v in zip(*hits, strict=True))
    chosen = rng.choice(len(hit), min(points, len(hit)), replace=False)
    depth = np.concatenate(depth_errors)
    figures = {"depth_median": float(np.median(depth)), "depth_90": float(np.percentile(depth, 90))}
    figures |= {"depth_bias": float(np.nanmedian(np.concatenate(signed)))}
    figures |= {"speckle": float(np.concatenate(speckles).mean())}
    return figures | _radiance(trainer, hit[chosen], normals[chosen], objects[chosen], rng)


def _speckle(error: np.ndarray, where: np.ndarray) -> np.ndarray:
    """How the errors (H, W, 3) of neighbours differ that both lie where a mask (H, W) says: (P, 3)."""
    beside = np.abs(np.diff(error, axis=1))[where[:, 1:] & where[:, :-1]]
    below = np.abs(np.diff(error, axis=0))[where[1:] & where[:-1]]
    return np.concatenate([beside, below])


def noise(one: Trainer, other: Trainer, views: int = 3) -> float:
    """Return the noise on the glossy ball of two models that differ in their seeds, in the first `views` test views."""
    scene, found = one.scene, []
    for index in scene.split("test")[:views]:
        camera = scene.views[index].camera
        rays = camera_rays(camera, scene.near, scene.far)
        t, _, objects = demo_scene.hit(rays.origins.double().numpy(), rays.directions.double().numpy())
        ball = (np.isfinite(t) & (objects == demo_scene.BALL)).reshape(camera.height, camera.width)
        drawn = [render_camera(trainer.method, camera, scene)[0] for trainer in (one, other)]
        found.append(_speckle(drawn[0] - drawn[1], ball))
    return float(np.concatenate(found).mean()) / np.sqrt(2)


def _radiance(
    trainer: Trainer, points: np.ndarray, normals: np.ndarray, objects: np.ndarray, rng: np.random.Generator
) -> dict[str, float]:
    centres = np.stack([trainer.scene.views[i].camera.c2w[:, 3] for i in trainer.scene.split("train")])
    errors: list[float] = []
    spreads: dict[str, list[tuple[float, float]]] = {"ball": [], "vase": []}
    names = {demo_scene.BALL: "ball", demo_scene.VASE: "vase"}
    outgoing = _seen_from(points, normals, centres, rng)
    counts = [len(directions) for directions in outgoing]
    # of all at once: a call of the scene's functions takes as long for a few points as for hundreds
    at, facing, things = (np.repeat(of_points, counts, 0) for of_points in (points, normals, objects))
    truth_of_all = demo_scene.radiance(at, facing, things, np.concatenate(outgoing))
    truths = np.split(truth_of_all, np.cumsum(counts)[:-1])
    for point, thing, directions, truth in zip(points, objects, outgoing, truths, strict=True):
        if len(directions) < 2:
            continue
        model = trainer.method.radiance(torch.from_numpy(point)[None], torch.from_numpy(-directions))[0].numpy()  # pyright: ignore[reportAttributeAccessIssue]: each method here has one
        errors.append(float(np.abs(model - truth).mean()))
        if thing in names:
            spreads[names[thing]].append((float(model.std(0).mean()), float(truth.std(0).mean())))
    figures = {"radiance_mean": float(np.mean(errors)), "radiance_median": float(np.median(errors))}
    for name, pairs in spreads.items():
        model, truth = np.mean(pairs, 0)
        figures |= {f"{name}_spread": float(model), f"{name}_spread_truth": float(truth)}
    return figures


def microscope(trainer: Trainer, pixels: int = 24, seed: int = 0) -> dict[str, float]:
    """Compare the radiance plot of opened pixels with the truth. Units are those of `compare`.

    The pixels are those of the first test view that truly see the glossy ball. Each figure is the median over them:

    off: the distance between the surface that the verdict finds, whose point is plotted, and the true one.
    observed: the error over the outward directions within OBSERVED of a photo that sees the point.
    extrapolated: the error over the other outward directions, which the plot hatches.
    spread: how much the colour changes over the observed directions; spread_truth: the same in truth.
    """
    scene, rng = trainer.scene, np.random.default_rng(seed)
    camera = scene.views[scene.split("test")[0]].camera
    rays = camera_rays(camera, scene.near, scene.far)
    t, normal, objects = demo_scene.hit(rays.origins.double().numpy(), rays.directions.double().numpy())
    shiny = np.flatnonzero(np.isfinite(t) & (objects == demo_scene.BALL))
    training_views, found = TrainingViews(scene), []
    for flat in rng.permutation(shiny)[:pixels].tolist():
        at = flat % camera.width, flat // camera.width
        *_, opened = pieces(trainer.method, training_views, camera, at, trainer.step_count, None, "viewer")
        assert opened.verdict is not None
        surface = opened.verdict.surface_t
        surface = opened.ray.point_t() if surface is None else surface
        opened = next(pieces(trainer.method, training_views, camera, at, trainer.step_count, surface, "viewer"))
        probe, evidence = opened.radiance, opened.evidence
        assert probe is not None
        assert evidence is not None
        outer = probe.directions @ normal[flat] > 0.2
        directions, rgb = probe.directions[outer], probe.rgb[outer]
        looks = evidence.directions[evidence.seen]
        near = (directions @ looks.T).max(-1, initial=-1) > np.cos(OBSERVED)
        where = rays.origins[flat].numpy() + t[flat] * rays.directions[flat].numpy()
        count = len(directions)
        truth = demo_scene.radiance(
            np.tile(where, (count, 1)), np.tile(normal[flat], (count, 1)), np.full(count, demo_scene.BALL), directions
        )
        error = np.abs(rgb - truth).mean(-1)
        found.append((
            abs(probe.t - t[flat]), _mean(error[near]), _mean(error[~near]), _spread(rgb[near]), _spread(truth[near]),
        ))  # fmt: skip
    names = ("off", "observed", "extrapolated", "spread", "spread_truth")
    return dict(zip(names, np.nanmedian(np.array(found), 0).tolist(), strict=True))


def _mean(errors: np.ndarray) -> float:
    """Return the mean error, or NaN if there are no errors."""
    return float(errors.mean()) if len(errors) else np.nan


def _spread(rgb: np.ndarray) -> float:
    """Return the RMS difference between colours (K, 3) and their mean, over all channels."""
    return float(np.sqrt(np.square(rgb - rgb.mean(0)).mean())) if len(rgb) else np.nan


def _seen_from(
    points: np.ndarray, normals: np.ndarray, centres: np.ndarray, rng: np.random.Generator
) -> list[np.ndarray]:
    """Unit directions (K, 3) from each point to at most CAMERAS training cameras that truly see it."""
    chosen = []
    for point, normal in zip(points, normals, strict=True):
        towards = centres - point
        distance = np.linalg.norm(towards, axis=-1)
        towards = towards / distance[:, None]
        facing = np.flatnonzero(towards @ normal > 0.2)  # a grazing view says little about a surface
        facing = rng.permutation(facing)[: 2 * CAMERAS]
        chosen.append((centres[facing], towards[facing], distance[facing]))
    starts, towards, distances = (np.concatenate(v) for v in zip(*chosen, strict=True))
    free = demo_scene.hit(starts, -towards)[0] > distances - 1e-3
    parts = np.split(free, np.cumsum([len(distance) for *_, distance in chosen])[:-1])
    return [directions[seen][:CAMERAS] for (_, directions, _), seen in zip(chosen, parts, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=300.0, help="seconds of training")
    parser.add_argument("--steps", type=int, default=0, help="instead: steps of training")
    parser.add_argument("--downscale", type=int, default=1, help="1: the scene's own size")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="constants of the method")
    parser.add_argument("--method", default="auto")
    parser.add_argument(
        "--twice", action="store_true", help="train a second model too, from another seed, for the noise"
    )
    args = parser.parse_args()
    changes = dict(word.split("=", 1) for word in args.set)
    scene = load_scene(None, LoadOptions(downscale=args.downscale))
    trainer, other = (Trainer(scene, RunSettings(method=args.method, changes=changes, seed=seed)) for seed in (0, 1))
    for part in (0.0, 0.25, 1.0):
        while trainer.step_count < part * args.steps if args.steps else trainer.seconds < part * args.seconds:
            trainer.step()
        while args.twice and other.step_count < trainer.step_count:
            other.step()
        for what, found in (("picture", compare(trainer)), ("microscope", microscope(trainer))):
            figures = ", ".join(f"{name} {value:.4f}" for name, value in found.items())
            print(f"{trainer.seconds:.0f} s, step {trainer.step_count}, {what}: {figures}", flush=True)
        if args.twice:
            print(f"noise {noise(trainer, other):.4f}", flush=True)


if __name__ == "__main__":
    main()
