"""Make a figure of one pixel at several steps of training, with a table of its numbers.

python examples/batch_of_figures.py
"""

import csv
from pathlib import Path

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.probe import open_pixel, write_inspection
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

STEPS = (5, 10, 20, 50, 200)  # fog becomes a surface


def main(out: Path = Path("runs/example"), steps: tuple[int, ...] = STEPS, downscale: int = 1) -> list[Path]:
    """Write a figure for each of `steps`, and `table.csv`, into the folder `out`; returns the figures' files."""
    scene = load_scene(None, LoadOptions(downscale=downscale))
    trainer = Trainer(scene, RunSettings(method="voxels", seed=0))
    camera = scene.views[scene.split("test")[0]].camera
    pixel = (int(0.68 * camera.width), int(0.6 * camera.height))  # column, row: on the blue ball
    files, rows = [], []
    for stop in steps:
        while trainer.step_count < stop:
            trainer.step()
        opened = open_pixel(trainer.method, scene, camera, pixel, trainer.step_count)
        assert opened.verdict is not None
        files.append(out / f"step-{stop:05d}.svg")
        write_inspection([opened], files[-1])
        rows.append((stop, opened.verdict.kind, opened.ray.opacity, opened.ray.depth_median))
    with (out / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("step", "verdict", "opacity", "median depth"))
        writer.writerows(rows)
    print(f"wrote {len(files)} figures and table.csv to {out}")
    return files


if __name__ == "__main__":
    main()
