"""Official constants, the nine rows of the ablation table, and values from the command line."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.methods.nerf.config import PRESETS, NerfConfig

CPU = torch.device("cpu")
# NeRF, table 2: everything that each row changes in the complete model
ROWS: dict[str, dict[str, Any]] = {
    "no-pe-viewdirs-hierarchy": {
        "position_frequencies": 0, "view_directions": False, "coarse_samples": 256, "fine_samples": 0
    },
    "no-pe": {"position_frequencies": 0, "direction_frequencies": 0},
    "no-viewdirs": {"view_directions": False},
    "no-hierarchy": {"coarse_samples": 256, "fine_samples": 0},
    "far-fewer-images": {"train_images": 25},
    "fewer-images": {"train_images": 50},
    "fewer-frequencies": {"position_frequencies": 5, "direction_frequencies": 2},
    "more-frequencies": {"position_frequencies": 15, "direction_frequencies": 6},
    "complete": {},
}  # fmt: skip


def test_official_constants_for_blender(scene: Scene) -> None:
    config = asdict(NerfConfig.configure(scene, "complete", {}, CPU))
    official = {
        "rays": 1024, "coarse_samples": 64, "fine_samples": 128, "position_frequencies": 10,
        "direction_frequencies": 4, "include_input": True, "pi": False, "view_directions": True, "depth": 8,
        "width": 256, "learning_rate": 5e-4, "decay": 0.1, "decay_steps": 500_000, "total_steps": 500_000,
        "adam_epsilon": 1e-7, "density_noise": 0.0, "one_image": True, "precrop_steps": 0, "train_images": 0,
        "last_delta": 1e10,
    }  # fmt: skip
    assert {name: config[name] for name in official} == official


def test_official_constants_for_photos(scene: Scene) -> None:
    config = NerfConfig.configure(replace(scene, synthetic=False), "complete", {}, CPU)
    assert (config.rays, config.one_image, config.density_noise) == (4096, False, 1.0)
    assert (config.decay_steps, config.total_steps) == (250_000, 200_000)


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("synthetic", [True, False])
def test_a_row_of_the_table_changes_what_it_says_and_nothing_else(scene: Scene, row: str, synthetic: bool) -> None:
    on = replace(scene, synthetic=synthetic)
    complete = NerfConfig.configure(on, "complete", {}, CPU)
    assert NerfConfig.configure(on, row, {}, CPU) == replace(complete, **ROWS[row])


def test_every_row_has_its_preset() -> None:
    assert set(PRESETS) == {*ROWS, "quick"}


def test_changes_override_the_preset(scene: Scene) -> None:
    assert NerfConfig.configure(scene, "quick", {"rays": "7"}, CPU).rays == 7
    words = {"rays": "7", "learning_rate": "1e-2", "pi": "True", "view_directions": "false"}
    config = NerfConfig.configure(scene, "more-frequencies", words, CPU)
    assert (config.rays, config.learning_rate, config.pi, config.view_directions) == (7, 1e-2, True, False)
    assert config.position_frequencies == 15


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"rayz": "3"}, "--set 'rayz': method nerf has no such constant; did you mean rays?"),
        ({"wings": "3"}, "--set 'wings': method nerf has no such constant; it has rays, "),
        ({"rays": "many"}, "--set rays='many': expected a whole number"),
        ({"rays": "0"}, "--set rays=0: must be at least 1"),
        ({"coarse_samples": "2"}, "--set coarse_samples=2: must be at least 3"),
        ({"learning_rate": "nan"}, "--set learning_rate=nan: must be at least 0"),
        ({"pi": "maybe"}, "--set pi='maybe': expected true or false"),
        ({"precrop": "0"}, r"--set precrop=0.0: must lie in \(0, 1\]"),
        ({"decay": "2"}, r"--set decay=2.0: must lie in \(0, 1\]"),
        ({"density_noise": "-1"}, "--set density_noise=-1.0: must be at least 0"),
    ],
)
def test_a_wrong_value_is_refused_with_what_is_right(scene: Scene, words: dict[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        NerfConfig.configure(scene, "complete", words, CPU)


def test_a_wrong_preset_lists_the_choices(scene: Scene) -> None:
    with pytest.raises(UserError, match=r"--preset 'fast': choose one of auto, complete, .*no-hierarchy"):
        NerfConfig.configure(scene, "fast", {}, CPU)


def test_a_configuration_survives_json(scene: Scene) -> None:
    config = NerfConfig.configure(scene, "no-pe", {}, CPU)
    assert NerfConfig.restore(json.loads(json.dumps(config.to_json()))) == config


def test_a_configuration_of_another_version_is_refused() -> None:
    stored = NerfConfig().to_json()
    del stored["pi"]
    with pytest.raises(UserError, match="differs in pi: made by another version"):
        NerfConfig.restore(stored)


@pytest.mark.parametrize(("name", "value"), [("rays", "many"), ("rays", 1.5), ("one_image", 1), ("decay", None)])
def test_a_configuration_of_wrong_types_is_refused(name: str, value: object) -> None:
    with pytest.raises(UserError, match=f"the checkpoint's {name} is .*: made by another version"):
        NerfConfig.restore(NerfConfig().to_json() | {name: value})
