"""The Flatland page: sliders begin a study or turn its knobs, and the mouse chooses a ray on the map and the strips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from imgui_bundle import imgui
from panel_screen import Screen
from panel_states import make_snapshot, make_state

from nerf_core.lab.flatland.rays import PIXELS, camera_rays, ring
from nerf_core.lab.flatland.view import FlatPass, FlatRay, FlatView
from nerf_core.lab.records import Curve, RowState, StudyState
from nerf_core.lab.studies.flatland import Flatland
from nerf_core.live.messages import CancelStudy, StartStudy, TurnKnob
from viewer.draw.flat_map import MARGIN, pixel_towards
from viewer.draw.flat_photos import GUTTER_EM, by_angle
from viewer.model.state import Action, AppState
from viewer.panels.flatland import FlatlandPanel

TRAINING, HELD_OUT = ring(4)
RAYS = camera_rays(TRAINING + HELD_OUT)


def make_view() -> FlatView:
    t = np.linspace(0.5, 2.2, 8)
    one = FlatPass("coarse", t, t, t / 4, 1 - t / 4, t / 16, np.full((8, 3), 0.5), np.full(3, 0.5))
    origin, direction = RAYS.origins[20].numpy(), RAYS.directions[20].numpy()
    ray = FlatRay(0, 20, origin, direction, 0.4, 2.4, (one, replace(one, name="fine")), np.ones(3), t, t)
    photos, field = np.zeros((8, PIXELS, 3), np.uint8), np.zeros((16, 16, 3), np.uint8)
    cameras = RAYS.origins[::PIXELS].numpy()
    return FlatView(cameras, 4, photos, photos + 1, field, field + 9, 250, 21.5, 60.0, ray)


@pytest.fixture
def page(screen: Screen) -> tuple[FlatlandPanel, AppState]:
    screen.size = (1000.0, 400.0)
    curves = (
        Curve("held-out photos", np.arange(3), np.array([9.0, 15.0, 21.5])),
        Curve("before", np.arange(2), np.ones(2)),
    )
    study = StudyState(
        "flatland", Path("x"), rows=(RowState("complete", "running"),), knobs=Flatland().knobs(), curves=curves,
        flat=make_view(),
    )  # fmt: skip
    return FlatlandPanel(), make_state(replace(make_snapshot(), study=study))


def hover(screen: Screen, panel: FlatlandPanel, state: AppState, x: float, y: float) -> dict[str, float]:
    imgui.get_io().add_mouse_pos_event(x, y)
    actions: list[Action] = [*screen.frame(panel, state), *screen.frame(panel, state)]
    assert all(isinstance(action, TurnKnob) for action in actions)
    return {action.knob: action.value for action in actions if isinstance(action, TurnKnob)}


def test_every_pixel_sees_what_lies_on_its_ray() -> None:
    view = make_view()
    for camera in (0, 3, 6):
        for pixel in (0, 20, 63):
            index = camera * PIXELS + pixel
            p = (RAYS.origins[index] + 1.1 * RAYS.directions[index]).numpy()
            assert pixel_towards(view, camera, p) == pixel


def test_the_mouse_chooses_a_ray_and_a_click_holds_it(screen: Screen, page: tuple[FlatlandPanel, AppState]) -> None:
    panel, state = page
    assert hover(screen, panel, state, 5, 5) == {"camera": 0.0, "pixel": PIXELS // 2}  # at first
    left, top, right, bottom = screen.widgets["flatland.field"]
    scale = (right - left) / (2 * MARGIN * np.linalg.norm(RAYS.origins[0].numpy()))

    def on_map(p: np.ndarray) -> tuple[float, float]:
        return float((left + right) / 2 + p[0] * scale), float((top + bottom) / 2 - p[1] * scale)

    seen = (RAYS.origins[20] + 1.2 * RAYS.directions[20]).numpy()
    assert hover(screen, panel, state, *on_map(seen)) == {"pixel": 20.0}
    held_out = RAYS.origins[5 * PIXELS].numpy()
    assert hover(screen, panel, state, *on_map(held_out)) == {"camera": 5.0}
    at = on_map((RAYS.origins[5 * PIXELS + 40] + 1.2 * RAYS.directions[5 * PIXELS + 40]).numpy())
    screen.drag(panel, state, at)  # a click
    assert hover(screen, panel, state, *on_map(held_out)) == {}  # it is held
    screen.drag(panel, state, at)
    low_x, low_y, far_x, far_y = screen.widgets["flatland.photos"]
    low_x += GUTTER_EM * screen.em
    row = by_angle(make_view()).tolist().index(2)
    strip = low_x + (far_x - low_x) * 10.5 / PIXELS, low_y + (far_y - low_y) * (row + 0.5) / 8
    assert hover(screen, panel, state, *strip) == {"camera": 2.0, "pixel": 10.0}


def test_a_slider_turns_a_running_study_and_begins_another(
    screen: Screen, page: tuple[FlatlandPanel, AppState]
) -> None:
    panel, state = page
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["flatland.cameras"]
    turned = screen.drag(panel, state, ((left + right) / 2, (top + bottom) / 2), (left + 2, top + 3))
    assert turned[-1] == TurnKnob("cameras", 2.0)
    assert screen.click(panel, state, "flatland.stop") == [CancelStudy()]
    stopped, begun = screen.click(panel, state, "flatland.again")[:2]
    assert stopped == CancelStudy()
    assert isinstance(begun, StartStudy)
    expected = {"frequencies": "4", "coarse": "24", "fine": "24", "cameras": "2", "noise": "0", "directions": "3"}
    assert begun.options == expected
    assert begun.folder.is_dir()
    study = state.snapshot.study
    assert study is not None
    state.snapshot = replace(state.snapshot, study=replace(study, state="cancelled", folder=begun.folder))
    assert screen.click(panel, state, "flatland.go_on")[0] == begun
    state.snapshot = replace(state.snapshot, study=replace(study, name="image"))
    assert "flatland.stop" not in screen.widgets
    assert screen.click(panel, state, "flatland.start") == []  # one at a time


@pytest.mark.parametrize("ended", ["done", "cancelled"])
def test_a_slider_that_is_let_go_begins_an_ended_study_again(
    screen: Screen, page: tuple[FlatlandPanel, AppState], ended: Literal["done", "cancelled"]
) -> None:
    panel, state = page
    study = state.snapshot.study
    assert study is not None
    state.snapshot = replace(state.snapshot, study=replace(study, state=ended))
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["flatland.fine"]
    (begun,) = screen.drag(panel, state, ((left + right) / 2, (top + bottom) / 2), (left + 2, top + 3))
    assert isinstance(begun, StartStudy)
    assert (begun.options["fine"], begun.options["cameras"]) == ("0", "16")
    new = replace(study, folder=begun.folder, knobs=Flatland(fine=0).knobs())
    state.snapshot = replace(state.snapshot, study=new)
    assert hover(screen, panel, state, 5, 5) == {"camera": 0.0, "pixel": PIXELS // 2}  # it is told the ray, too
    assert panel._page.values == {}


def test_it_shows_the_world_and_the_pictures_once(screen: Screen, page: tuple[FlatlandPanel, AppState]) -> None:
    panel, state = page
    screen.frame(panel, state)
    screen.frame(panel, state)
    field = screen.pictures["flatland.field picture"]
    screen.frame(panel, state)
    assert screen.pictures["flatland.field picture"] is field
    screen.click(panel, state, "flatland.show.world")
    screen.frame(panel, state)
    assert (screen.pictures["flatland.field picture"][..., :3] == 9).all()
    rows = screen.pictures["flatland photos"][..., :3]
    assert (rows[0::2] == 0).all()
    assert (rows[1::2] == 1).all()  # what is learnt is below
    screen.size = (1270.0, 380.0)
    screen.frame(panel, state)
    screen.frame(panel, state)
    assert "flatland.world" in screen.widgets  # there is room for both
