"""Draw the view with which the window opens twelve kinds of captures, as one sheet, and measure it.

    python tests/benchmarks/first_views.py [--scenes DIR] [--poses fast] [--only NAME …] [--steps 500] [--out FILE.png]

Eight kinds are rendered in closed form (tests/helpers/arrangements.py) and opened as COLMAP models with sparse points.
DIR holds real captures: lego, fox, fern, can; with --poses, can is also opened with poses found anew, which takes long.
Each is trained for some steps at a low resolution, and drawn from the window's first camera. The table gives, where the
truth is known: the angle between the scene's up and the true one, and the roll of the picture; where the subject's
middle is, as shares of width and height; the share of the picture that the subject fills; the depth of the nearest
thing in the picture; and the share of pixels where the model shows something before 0.7 of the true depth, as fog does.
For all: the verdict of the pixel in the middle, as the microscope gives it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nerf_core.captures.opening import open_capture
from nerf_core.captures.posing import PoseOptions, find_poses
from nerf_core.captures.raw_photos import RawPhotos
from nerf_core.common.assets import assets_dir
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.probe import open_pixel
from nerf_core.rendering.images import render_camera, to_bytes
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from viewer.model.camera_control import CameraControl

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from arrangements import UP, Arrangement, arrangements, draw, in_world, write

VIEW = (400, 300)  # pixels of a picture on the sheet
COLUMNS, LABEL = 4, 40
REAL = ("lego", "fox", "fern", "can")
FOG = 0.7  # of the true depth


def captures(args: argparse.Namespace, scratch: Path) -> Iterator[tuple[str, Path, Arrangement | None]]:
    """The name and path of each capture, and its truth if it is rendered."""
    for name, arrangement in arrangements().items():
        if not args.only or name in args.only:
            yield name, write(scratch / name, arrangement), arrangement
    for name in REAL if args.scenes else ():
        if not args.only or name in args.only:
            yield name, args.scenes / name, None
    found = "can, found poses"
    if args.scenes and args.poses and (not args.only or found in args.only):
        folder = args.scenes / "can/images"
        photos = tuple(sorted(file for file in folder.iterdir() if file.suffix == ".jpg"))
        out = scratch / "can found"
        find_poses(RawPhotos(folder, folder, photos), out, PoseOptions(quality=args.poses), lambda _: None)
        yield found, out, None


def measured(camera: Camera, depth: np.ndarray, scene: Scene, truth: Arrangement) -> str:
    """The columns of the table whose truth is known."""
    camera = in_world(camera, scene, truth)
    turn = in_world(Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4)[:3]), scene, truth).c2w[:, :3]
    metre = np.cbrt(np.linalg.det(scene.to_input[:3, :3])) * truth.unit
    _, t, index = draw(truth.world, camera)
    seen = camera.c2w[:, :3].T @ UP
    place = "–"
    if truth.target is not None:
        pixels, _ = camera.project(np.array([truth.target]))
        place = "{:.2f}, {:.2f}".format(*(pixels[0] / (camera.width, camera.height)))
    subject = np.array([box.subject for box in truth.world] + [False])[index].mean()
    foggy = (depth * metre < FOG * t)[np.isfinite(t)].mean()
    off = np.degrees(np.arccos(np.clip(turn @ scene.up @ UP, -1, 1)))
    roll = np.degrees(np.arctan2(seen[0], seen[1]))
    return f"{off:.1f}° | {roll:.1f}° | {place} | {subject:.0%} | {t.min():.2f} m | {foggy:.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--poses", choices=("fast", "normal", "high"))
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--max-size", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("first_views.png"))
    args = parser.parse_args()
    settings = RunSettings(load=LoadOptions(max_size=args.max_size), method="voxels")
    tiles = []
    print("capture | up off | roll | subject at | fills | nearest | fog | verdict in the middle")
    with tempfile.TemporaryDirectory() as scratch:
        for name, path, truth in captures(args, Path(scratch)):
            scene = open_capture(path, settings.load)
            trainer = Trainer(scene, settings)
            while trainer.step_count < args.steps:
                trainer.step()
            control = CameraControl()
            control.set_scene(scene)
            camera = control.camera(*VIEW)
            color, depth = render_camera(trainer.method, camera, scene)
            opened = open_pixel(trainer.method, scene, camera, (VIEW[0] // 2, VIEW[1] // 2), trainer.step_count)
            verdict = opened.verdict.kind if opened.verdict else "–"
            line = measured(camera, depth, scene, truth) if truth else "– | – | – | – | – | –"
            print(f"{name} | {line} | {verdict}", flush=True)
            tiles.append((f"{name}: {verdict}", to_bytes(color)))
    sheet(tiles).save(args.out)
    print(f"wrote {args.out}")


def sheet(tiles: list[tuple[str, np.ndarray]]) -> Image.Image:
    """The pictures side by side, each under its label."""
    width, height = VIEW
    rows = -(-len(tiles) // COLUMNS)
    page = Image.new("RGB", (COLUMNS * (width + 8) + 8, rows * (height + LABEL) + 8), (24, 26, 30))
    pen, font = ImageDraw.Draw(page), ImageFont.truetype(str(assets_dir() / "fonts/Roboto-Regular.ttf"), 20)
    for k, (label, picture) in enumerate(tiles):
        left, top = 8 + k % COLUMNS * (width + 8), k // COLUMNS * (height + LABEL)
        pen.text((left, top + 10), label, (235, 235, 235), font)
        page.paste(Image.fromarray(picture), (left, top + LABEL))
    return page


if __name__ == "__main__":
    main()
