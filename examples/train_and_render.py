"""Train a model on the demo scene, render a held-out photo, and measure it.

    python examples/train_and_render.py

Replace None in `load_scene` by Path("photos") for a capture of your own.
"""

from pathlib import Path

import numpy as np

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.rendering.images import render_camera, to_bytes
from nerf_core.rendering.video import write_png
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def main(out: Path = Path("runs/example"), steps: int = 500, downscale: int = 1) -> float:
    """Write `rendering.png` and `photo.png` into the folder `out`; returns the PSNR of the rendering in dB."""
    scene = load_scene(None, LoadOptions(downscale=downscale))
    trainer = Trainer(scene, RunSettings(method="voxels", seed=0))
    for _ in range(steps):
        report = trainer.step()
        if report.step % 100 == 0:
            print(f"step {report.step}: {report.psnr:.2f} dB on the training rays")
    index = scene.split("test")[0]
    color, depth = render_camera(trainer.method, scene.views[index].camera, scene)  # (H, W, 3), (H, W)
    photo = scene.images[index] / np.float32(65535)
    psnr = float(-10 * np.log10(np.mean((color - photo) ** 2)))
    write_png(out / "rendering.png", to_bytes(color))
    write_png(out / "photo.png", to_bytes(photo))
    print(f"{scene.views[index].name}: {psnr:.2f} dB, median depth {np.nanmedian(depth):.2f}; wrote {out}")
    return psnr


if __name__ == "__main__":
    main()
