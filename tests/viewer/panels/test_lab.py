"""The Lab panel starts, cancels and turns studies, and shows what they have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from panel_screen import Screen
from panel_states import make_snapshot, make_state, make_study

from nerf_core.common.configs import constants
from nerf_core.lab.study import STUDIES
from nerf_core.live.messages import CancelStudy, Snapshot, StartStudy, TurnKnob
from viewer.model.state import AppState
from viewer.panels.lab import LabPanel
from viewer.ui.contract import Panel


@pytest.fixture
def panel() -> Panel:
    return LabPanel()


def opened(screen: Screen, panel: Panel, state: AppState, name: str) -> None:
    """Bring a study's tab to the front."""
    screen.size = (900.0, 700.0)
    screen.click(panel, state, f"lab.{name}")


@pytest.mark.parametrize("name", STUDIES.names())
def test_a_study_starts_with_the_options_that_were_typed(screen: Screen, panel: Panel, name: str) -> None:
    state = make_state(make_snapshot())
    opened(screen, panel, state, name)
    kind = STUDIES.get(name)
    screen.frame(panel, state)
    assert {f"lab.{name}.{key}" for key in constants(kind)} <= set(screen.widgets)
    key = next(iter(constants(kind)))
    screen.click(panel, state, f"lab.{name}.{key}")
    imgui.get_io().add_input_characters_utf8("7")
    screen.frame(panel, state)
    folder = Path.cwd() / "lab" / (f"spheres-{name}" if kind.of_scene else name)
    actions = screen.click(panel, state, f"lab.start.{name}")
    assert actions == [StartStudy(name, {key: "7"}, actions[0].folder)]  # pyright: ignore
    assert Path.cwd() / actions[0].folder == folder  # pyright: ignore


def test_a_study_of_a_capture_needs_one(screen: Screen, panel: Panel) -> None:
    state = make_state(Snapshot())
    opened(screen, panel, state, "compare")
    assert screen.click(panel, state, "lab.start.compare") == []


def test_before_torch_is_loaded_no_study_is_asked_for(
    screen: Screen, panel: Panel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(STUDIES), "names", lambda self: pytest.fail("that would load torch"))
    screen.frame(panel, make_state(replace(Snapshot(), status="loading", loading="PyTorch is loading")))


def test_a_running_study_is_cancelled_and_turned(screen: Screen, panel: Panel) -> None:
    state = make_state(replace(make_snapshot(), study=make_study("running")))
    screen.size = (900.0, 700.0)
    assert screen.click(panel, state, "lab.cancel") == [CancelStudy()]
    left, top, right, bottom = screen.widgets["lab.knob.L"]
    middle = (top + bottom) / 2
    turned = screen.drag(panel, state, (left + 5, middle), (right - 5, middle))
    assert [type(action) for action in turned] == [TurnKnob]
    assert turned == [TurnKnob("L", 12.0)]
    opened(screen, panel, state, "memory")
    assert screen.click(panel, state, "lab.start.memory") == []  # one at a time


def test_the_tab_of_a_study_that_begins_comes_to_the_front(screen: Screen, panel: Panel) -> None:
    state = make_state(make_snapshot())
    opened(screen, panel, state, "memory")
    state.snapshot = replace(state.snapshot, study=make_study("running", "sampling"))
    for _ in range(3):
        screen.frame(panel, state)
    assert "lab.cancel" in screen.widgets
    screen.click(panel, state, "lab.memory")
    screen.frame(panel, state)
    assert "lab.cancel" not in screen.widgets  # and the user may look at another


def test_pictures_are_uploaded_once_and_figures_come_at_the_end(screen: Screen, panel: Panel) -> None:
    state = make_state(replace(make_snapshot(), study=make_study("running")))
    screen.size = (900.0, 700.0)
    screen.frame(panel, state)
    screen.frame(panel, state)
    first = dict(screen.pictures)
    assert {"lab voxels", "lab nerf"} <= set(first)
    assert {"lab.look.voxels", "lab.look.nerf", "lab.curves"} <= set(screen.widgets)
    screen.frame(panel, state)
    assert all(screen.pictures[key] is picture for key, picture in first.items())
    assert "lab.figure.compare" not in screen.widgets
    state.snapshot = replace(state.snapshot, study=make_study("done"))
    screen.frame(panel, state)
    assert "lab.figure.compare" in screen.widgets
    assert screen.pictures["lab voxels"] is not first["lab voxels"]  # it is another picture now
    np.testing.assert_array_equal(screen.pictures["lab voxels"][..., 3], 255)
