"""Compare a model trained on the demo scene with the scene's closed-form depth and radiance."""

from __future__ import annotations

import pytest
from demo_truth import compare, microscope, noise

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

FEWEST = 3


def long(seconds: int) -> tuple[pytest.MarkDecorator, ...]:
    return pytest.mark.thorough(seconds), pytest.mark.timeout(3600)


# shrink: the depth error must shrink by this factor. It is small for a grid, which begins as an even fog whose mean
# depth is not far off. A network begins anywhere. counts: test views, surface points and pixels of the ball to compare.
# Before training, a third of these pixels is opened, but at least FEWEST: a ray through fog takes long.
@pytest.mark.parametrize(
    ("method", "preset", "downscale", "steps", "shrink", "counts"),
    [
        pytest.param("voxels", "auto", 8, 60, 2, (1, 60, 6), id="voxels-briefly"),
        pytest.param("voxels", "auto", 4, 140, 3, (2, 400, 16), id="voxels", marks=long(15)),
        pytest.param("nerf", "quick", 4, 1000, 5, (2, 200, 9), id="nerf", marks=long(80)),
    ],
)
def test_training_approaches_the_truth(
    method: str, preset: str, downscale: int, steps: int, shrink: float, counts: tuple[int, int, int]
) -> None:
    """Compare before and after some steps on smaller photos. One training serves all checks."""
    views, points, pixels = counts
    settings = RunSettings(method=method, preset=preset)
    trainer = Trainer(load_scene(None, LoadOptions(downscale=downscale)), settings)
    before = compare(trainer, views, points) | microscope(trainer, max(pixels // 3, FEWEST))
    while trainer.step_count < steps:
        trainer.step()
    after = compare(trainer, views, points) | microscope(trainer, pixels)

    assert after["depth_median"] < 0.3  # scene units; the content is 2.6 across
    assert after["depth_median"] < before["depth_median"] / shrink

    assert after["radiance_mean"] < 0.2
    assert after["radiance_mean"] < 0.85 * before["radiance_mean"]

    # observed: directions near those of photos. At the others the plot extrapolates and is hatched: larger errors.
    assert after["off"] < 0.15
    assert after["off"] < before["off"] / 4
    assert after["observed"] < 0.15
    assert after["observed"] < 0.75 * before["observed"]
    assert after["extrapolated"] > 1.2 * after["observed"]
    assert 0.2 * after["spread_truth"] < after["spread"] < 1.5 * after["spread_truth"]


def test_noise_is_what_two_seeds_do_not_share() -> None:
    scene = load_scene(None, LoadOptions(downscale=8))
    one, same, other = (Trainer(scene, RunSettings(method="voxels", seed=seed)) for seed in (0, 0, 1))
    for trainer in (one, same, other):
        for _ in range(5):
            trainer.step()
    assert noise(one, same, 1) == 0
    assert 0 < noise(one, other, 1) < 0.1
