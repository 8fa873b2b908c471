"""A model that is trained on the demo scene, against the scene's closed-form depth and radiance."""

from __future__ import annotations

import pytest
from demo_truth import compare, microscope

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.settings import RunSettings
from nerf_core.trainer import Trainer

# Preset, steps, and how many times nearer the depth must come: a grid begins as an even fog, whose mean depth is not
# far off, a network anywhere.
CASES = {"nerf": ("quick", 800, 5), "voxels": ("auto", 400, 3)}
Figures = tuple[str, dict[str, float], dict[str, float]]


@pytest.fixture(scope="module", params=["nerf", "voxels"])
def figures(request: pytest.FixtureRequest) -> Figures:
    """Before and after some hundred steps, at a sixteenth of the photos' pixels."""
    method = request.param
    preset, steps, _ = CASES[method]
    trainer = Trainer(load_scene(None, LoadOptions(downscale=4)), RunSettings(method=method, preset=preset))
    before = compare(trainer, views=2) | microscope(trainer)
    while trainer.step_count < steps:
        trainer.step()
    return method, before, compare(trainer, views=2) | microscope(trainer)


def test_depth_approaches_the_truth(figures: Figures) -> None:
    method, before, after = figures
    assert after["depth_median"] < 0.3  # scene units; the content is 2.6 across
    assert after["depth_median"] < before["depth_median"] / CASES[method][2]


def test_radiance_approaches_the_truth(figures: Figures) -> None:
    _, before, after = figures
    assert after["radiance_mean"] < 0.2
    assert after["radiance_mean"] < 0.85 * before["radiance_mean"]


def test_the_microscope_approaches_the_truth_where_photos_have_looked_from(figures: Figures) -> None:
    """Elsewhere it extrapolates: there the plot is hatched, and the error is larger indeed."""
    _, before, after = figures
    assert after["off"] < 0.15
    assert after["off"] < before["off"] / 4
    assert after["observed"] < 0.15
    assert after["observed"] < 0.75 * before["observed"]
    assert after["extrapolated"] > 1.2 * after["observed"]
    assert 0.2 * after["spread_truth"] < after["spread"] < 1.5 * after["spread_truth"]
