"""A model that is trained on the demo scene, against the scene's closed-form depth and radiance."""

from __future__ import annotations

import pytest
from demo_truth import compare

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.settings import RunSettings
from nerf_core.trainer import Trainer


@pytest.fixture(scope="module")
def figures() -> tuple[dict[str, float], dict[str, float]]:
    """Before and after some hundred steps, at a sixteenth of the photos' pixels."""
    trainer = Trainer(load_scene(None, LoadOptions(downscale=4)), RunSettings(preset="quick"))
    before = compare(trainer, views=2)
    while trainer.step_count < 800:
        trainer.step()
    return before, compare(trainer, views=2)


def test_depth_approaches_the_truth(figures: tuple[dict[str, float], dict[str, float]]) -> None:
    before, after = figures
    assert after["depth_median"] < 0.3  # scene units; the content is 2.6 across
    assert after["depth_median"] < before["depth_median"] / 5


def test_radiance_approaches_the_truth(figures: tuple[dict[str, float], dict[str, float]]) -> None:
    before, after = figures
    assert after["radiance_mean"] < 0.2
    assert after["radiance_mean"] < 0.85 * before["radiance_mean"]
