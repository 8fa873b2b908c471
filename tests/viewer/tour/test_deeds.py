"""Directives and conditions that need no window: what they ask of app and worker, and when they hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from panel_states import make_snapshot, make_state

from nerf_core.common.errors import UserError
from nerf_core.lab.records import StudyState
from nerf_core.live.messages import InOrder, Inspect, Notice, OpenScene, SaveUnsaved, StartStudy, UseMethod
from viewer import cli
from viewer.model.state import AppState, FrameScene, ShownNotice
from viewer.tour.conditions import before, condition
from viewer.tour.deeds import DEEDS, own_study
from viewer.tour.models import Model, Models, wanted
from viewer.tour.steps import parse_step
from viewer.tour.values import VALUES


def opened_state(**changes: object) -> AppState:
    state = make_state(replace(make_snapshot(), **changes))  # pyright: ignore[reportArgumentType]
    assert state.snapshot.scene is not None
    state.camera.set_scene(state.snapshot.scene)
    return state


def changed(state: AppState, **changes: object) -> None:
    state.snapshot = replace(state.snapshot, **changes)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("text", "do"),
    [
        ("step 5000", lambda s: changed(s, step=5000)),
        ("psnr 60", lambda s: changed(s, history=replace(s.snapshot.history, psnr=np.full(30, 61, np.float32)))),
        ("training", lambda s: changed(s, status="training")),
        ("study image", lambda s: changed(s, study=StudyState("image", Path("x"), "running", ()))),
        ("panel Ray by hand", lambda s: setattr(s, "in_front", ("Ray by hand",))),
        ("pins 9", lambda s: changed(s, pins=s.snapshot.pins * 9)),
        ("mode view-dependence", lambda s: setattr(s, "mode", "view-dependence")),
    ],
)
def test_a_condition_holds_once_it_is_so(text: str, do: Callable[[AppState], None]) -> None:
    state = opened_state(status="paused", step=10)
    begun = before(state)
    found = condition(text)
    assert not found.holds(state, begun)
    assert condition("paused").holds(state, begun)
    do(state)
    assert found.holds(state, begun)


def test_a_ray_near_a_point_of_the_captures_own_coordinates() -> None:
    state = opened_state()
    scene, ray = state.snapshot.scene, state.snapshot.ray
    assert scene is not None
    assert ray is not None
    assert state.inspect is not None
    begun = replace(before(state), ray=0)
    beside = np.cross(ray.direction, [0.0, 0.0, 1.0]) * 0.2
    for off, holds in ((np.zeros(3), True), (beside, False)):
        point = ray.origin + 2 * ray.direction + off
        x, y, z = (np.asarray(scene.to_input) @ [*point, 1.0])[:3]
        scale = np.linalg.norm(np.asarray(scene.to_input)[:3, 0])
        found = condition(f"opened near {x} {y} {z} {0.1 * scale}")
        assert found.holds(state, begun) is holds
        assert not found.holds(state, before(state))  # it was open before


def test_open_hits_the_pixel_of_the_point() -> None:
    state = opened_state()
    scene = state.snapshot.scene
    assert scene is not None
    camera = state.camera.camera(*state.viewport)
    world = camera.c2w @ [0.3, -0.2, -3.0, 1.0]
    x, y, z = (np.asarray(scene.to_input) @ [*world, 1.0])[:3]
    (ray,) = DEEDS["open"](f"{x} {y} {z}").do(state)
    assert isinstance(ray, Inspect)
    assert ray.pixel == (int(camera.cx + camera.fx * 0.1), int(camera.cy + camera.fy * 0.2 / 3))
    behind = camera.c2w @ [0.0, 0.0, 3.0, 1.0]
    x, y, z = (np.asarray(scene.to_input) @ [*behind, 1.0])[:3]
    assert DEEDS["open"](f"{x} {y} {z}").do(state) == []


def test_commands_and_studies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    state = opened_state(study=None)
    assert DEEDS["do"]("camera.frame").do(state) == [FrameScene()]
    (start,) = DEEDS["study"]("image size=64").do(state)
    assert isinstance(start, StartStudy)
    assert (start.name, start.options) == ("image", {"size": "64"})
    assert tmp_path in start.folder.parents
    changed(state, study=StudyState("image", start.folder, "running", ()))
    assert own_study(state) == "image"
    assert not DEEDS["study"]("flatland").ready(state)  # until the step's study has stopped
    changed(state, study=StudyState("image", tmp_path / "mine", "running", ()))
    assert own_study(state) == ""
    assert DEEDS["study"]("flatland").do(state) == []  # the reader's own study is not disturbed


def test_a_step_has_the_model_of_the_steps_before_it() -> None:
    texts = ("# A\na\n@method voxels", "# B\nb\n@scene mine\n@method nerf depth=2", "# C\nc", "# D\nd\n@method hash")
    steps = [parse_step(text, "x", "x.md") for text in texts]
    assert wanted(steps, 0, "demo") == Model("demo", "voxels")
    assert wanted(steps, 2, "demo") == Model("mine", "nerf", (("depth", "2"),))
    assert wanted(steps, 3, "") == Model("mine", "hash")


def test_models_are_opened_as_the_steps_write_them(tmp_path: Path) -> None:
    state, models = opened_state(step=10, saved_step=10, method="nerf"), Models(tmp_path)
    assert models.open(state, Model("", "nerf")) is None  # the reader's own will do
    state.snapshot = replace(state.snapshot, step=20)
    found = models.open(state, Model("mine", "hash"))
    assert isinstance(found, InOrder)
    save, opening = found.commands
    assert isinstance(save, SaveUnsaved)
    assert isinstance(opening, OpenScene)
    assert (opening.path, opening.options.method) == (tmp_path / "mine", "hash")
    assert models.waiting(state)
    state.notices.append(ShownNotice(Notice("error", "no such folder", kind="failed"), 0.0))
    assert not models.waiting(state)
    assert models.open(state, Model("mine", "hash")) is None  # it was refused: the tour goes on with what is open
    found = models.open(state, Model("", "nerf", (("depth", "2"),)))
    assert isinstance(found, InOrder)
    assert found.commands[1] == UseMethod("nerf", train=True, changes={"depth": "2"})


def test_values_without_a_ray_are_dashes_and_the_last_stretch_has_no_end() -> None:
    assert {name: read(AppState()) for name, read in VALUES.items() if name not in ("step", "N3")} == dict.fromkeys(
        (name for name in VALUES if name not in ("step", "N3")), "–"
    )
    state = opened_state()
    assert state.snapshot.opened is not None
    ray = state.snapshot.opened.ray
    last = ray.passes[-1]
    endless = replace(ray, passes=(*ray.passes[:-1], replace(last, delta=np.full_like(last.delta, 1e10))))
    changed(state, opened=replace(state.snapshot.opened, ray=endless))
    assert VALUES["delta"](state) == "∞"
    assert VALUES["heaviest"](state) == f"{last.weights.argmax() + 1}"


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli._with_tour(["--tour"]) == ["--tour", ""]
    assert cli._with_tour(["x", "--tour", "--presenter"]) == ["x", "--tour", "", "--presenter"]
    assert cli._with_tour(["--tour", "mine"]) == ["--tour", "mine"]
    (tmp_path / "1.md").write_text("# A\n@fly")
    with pytest.raises(UserError, match="no such directive"):
        cli._folder(str(tmp_path))
    assert cli.main(["--tour", "--headless", "--size", "320x200"]) == 2
    assert "--tour: a tour is for a reader" in capsys.readouterr().err
