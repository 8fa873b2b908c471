"""Training options become settings; a wrong one is refused in one line that names it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, LoadOptions
from nerf_core.methods import METHODS
from nerf_core.training.loop import Goal
from nerf_core.training.options import TrainOptions, run_name
from nerf_core.training.settings import RunSettings


def test_defaults_are_the_settings_own() -> None:
    assert TrainOptions().settings() == RunSettings()


def test_every_option_arrives() -> None:
    options = TrainOptions(
        format="llff", downscale=2, max_size=300, ndc="on", background="black", memory_gb=1.5, method="nerf",
        preset="quick", set=["rays=8", "learning_rate=1e-3"], steps=7, seed=3, device="cpu", threads=2,
    )  # fmt: skip
    assert options.settings() == RunSettings(
        load=LoadOptions("llff", 2, 300, "on", "black", 1.5), method="nerf", preset="quick",
        changes={"rays": "8", "learning_rate": "1e-3"}, steps=7, seed=3, device="cpu", threads=2,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"steps": 0}, "--steps 0"),
        ({"seconds": 0.0}, "--seconds 0"),
        ({"seconds": math.nan}, "--seconds nan"),
        ({"seed": -1}, "--seed -1"),
        ({"threads": -1}, "--threads -1"),
        ({"method": "magic"}, f"--method 'magic': choose from auto, {', '.join(METHODS.names())}"),
        ({"format": "doc"}, f"--format 'doc': choose from auto, {', '.join(DATASETS.names())}"),
        ({"set": ["rays"]}, "--set 'rays': write NAME=VALUE"),
        ({"set": ["=3"]}, "--set '=3': write NAME=VALUE"),
        ({"set": ["rays="]}, "--set 'rays=': write NAME=VALUE"),
        ({"set": ["rays=3", "rays=4"]}, "--set rays: given as '3' and '4'"),
    ],
)
def test_wrong_values_name_the_option(wrong: dict[str, object], text: str) -> None:
    with pytest.raises(UserError) as caught:
        replace(TrainOptions(), **wrong).settings()  # pyright: ignore[reportArgumentType]
    assert str(caught.value).startswith(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "goal"),
    [
        (TrainOptions(), Goal(500, math.inf)),
        (TrainOptions(steps=7), Goal(7, math.inf)),
        (TrainOptions(seconds=3.5), Goal(500, 3.5)),
        (TrainOptions(steps=7, seconds=3.5), Goal(7, 3.5)),
    ],
)
def test_the_goal_is_the_schedule_unless_asked(options: TrainOptions, goal: Goal) -> None:
    assert options.goal(500) == goal


def test_runs_are_named_after_the_scene(tmp_path: Path) -> None:
    file = tmp_path / "fox" / "transforms.json"
    file.parent.mkdir()
    file.touch()
    assert [run_name(p, "nerf") for p in (None, file.parent, file)] == ["demo-nerf", "fox-nerf", "fox-nerf"]


@pytest.mark.parametrize("name", ["x" * 255, "ü" * 127, "\udcff" * 255], ids=["letters", "two bytes", "not UTF-8"])
def test_the_name_of_a_run_fits(name: str, tmp_path: Path) -> None:
    """Also if the capture's name has the 255 bytes that systems allow."""
    folder = tmp_path / name
    folder.mkdir()
    run = run_name(folder, "voxels")
    (tmp_path / run).mkdir()
    assert run.endswith("-voxels")
    assert run.startswith(name[:100])
