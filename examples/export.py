"""Export a trained model: an orbit video, a picture as floating-point numbers, and a checkpoint.

python examples/export.py
"""

from pathlib import Path

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.paths.orbit import Orbit
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.jobs import Job
from nerf_core.rendering.export.requests import ExportPath, ExportStill
from nerf_core.rendering.export.still import StillJob
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


def main(
    out: Path = Path("runs/example"), steps: int = 500, downscale: int = 1, frames: int = 30, side: int = 200
) -> list[Path]:
    """Write `orbit.mp4`, `picture.npy` and `model.safetensors` into the folder `out`; returns the files."""
    scene = load_scene(None, LoadOptions(downscale=downscale))
    trainer = Trainer(scene, RunSettings(method="voxels", seed=0))
    for _ in range(steps):
        trainer.step()
    cameras = Orbit.cameras(scene, frames, side, side, elevation=20.0)
    film, still = out / "orbit.mp4", out / "picture.npy"
    finish(FilmJob(trainer.method.frozen(), scene, ExportPath(cameras, 24.0, film)))
    finish(StillJob(trainer.method.frozen(), scene, ExportStill(cameras[0], still)))
    model = out / "model.safetensors"
    checkpoint.save(model, trainer.describe(), trainer.state())
    print(f"wrote {film}, {still} and {model}")
    return [film, still, model]


def finish(job: Job) -> None:
    """Render tile after tile. A program that has other things to do can do them between two tiles."""
    try:
        while job.advance():
            pass
    finally:
        job.abort()  # removes an unfinished file; does nothing to a finished one


if __name__ == "__main__":
    main()
