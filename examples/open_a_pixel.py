"""Open a pixel: why does it have its colour, and which training photos know?

python examples/open_a_pixel.py
"""

from pathlib import Path

import numpy as np

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.probe import Opened, open_pixel, write_inspection
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def main(out: Path = Path("runs/example"), steps: int = 500, downscale: int = 1) -> Opened:
    """Write `ray.json` and `ray.svg` into the folder `out`; returns the opened pixel."""
    scene = load_scene(None, LoadOptions(downscale=downscale))
    trainer = Trainer(scene, RunSettings(method="voxels", seed=0))
    for _ in range(steps):
        trainer.step()
    camera = scene.views[scene.split("test")[0]].camera
    pixel = (int(0.68 * camera.width), int(0.6 * camera.height))  # column, row: on the blue ball
    opened = open_pixel(trainer.method, scene, camera, pixel, trainer.step_count)

    ray, samples = opened.ray, opened.ray.passes[-1]  # the last pass makes the pixel
    assert opened.verdict is not None
    assert opened.radiance is not None
    assert opened.evidence is not None
    print(f"colour {np.round(ray.color, 3)}, opacity {ray.opacity:.3f}, {len(samples.t)} samples")
    print(f"{opened.verdict.kind}: {'; '.join(opened.verdict.reasons)}")
    if len(samples.t):
        k = int(samples.weights.argmax())
        print(f"the strongest sample lies at t = {samples.t[k]:.3f} and makes {samples.weights[k]:.0%} of the pixel")
    print(f"view-dependence of the point at t = {opened.radiance.t:.3f}: {opened.radiance.dependence:.3f}")
    for view in opened.evidence.at(opened.evidence.seen).views[:5]:
        print(f"seen by {scene.views[view].name}")
    for name in ("ray.json", "ray.svg"):
        write_inspection([opened], out / name)
    return opened


if __name__ == "__main__":
    main()
