"""A model that is trained on the demo scene, against the scene's closed-form depth and radiance."""

from __future__ import annotations

import pytest
from demo_truth import compare, microscope

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

# Preset, steps, and how many times nearer the depth must come: a grid begins as an even fog, whose mean depth is not
# far off, a network anywhere.
CASES = {"nerf": ("quick", 800, 5), "voxels": ("auto", 400, 3)}


@pytest.mark.parametrize("method", CASES)
def test_training_approaches_the_truth(method: str) -> None:
    """Before and after some hundred steps, at a sixteenth of the photos' pixels: trained once for all that is asked."""
    preset, steps, nearer = CASES[method]
    trainer = Trainer(load_scene(None, LoadOptions(downscale=4)), RunSettings(method=method, preset=preset))
    before = compare(trainer, views=2) | microscope(trainer)
    while trainer.step_count < steps:
        trainer.step()
    after = compare(trainer, views=2) | microscope(trainer)

    assert after["depth_median"] < 0.3  # scene units; the content is 2.6 across
    assert after["depth_median"] < before["depth_median"] / nearer

    assert after["radiance_mean"] < 0.2
    assert after["radiance_mean"] < 0.85 * before["radiance_mean"]

    # Where photos have looked from; elsewhere it extrapolates: there the plot is hatched, and the error larger indeed.
    assert after["off"] < 0.15
    assert after["off"] < before["off"] / 4
    assert after["observed"] < 0.15
    assert after["observed"] < 0.75 * before["observed"]
    assert after["extrapolated"] > 1.2 * after["observed"]
    assert 0.2 * after["spread_truth"] < after["spread"] < 1.5 * after["spread_truth"]
