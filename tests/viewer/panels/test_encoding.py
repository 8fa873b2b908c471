"""The Encoding page: what is painted is learnt, sliders turn the running study, and γ(p) is that of the methods."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from panel_screen import Screen
from panel_states import make_snapshot, make_state, make_study
from PIL import Image

from nerf_core.lab.image_fit import ImageConfig, encode, frequencies
from nerf_core.live.messages import CancelStudy, StartStudy, TurnKnob
from nerf_core.volume import encodings
from viewer.draw.encoding_waves import equation, place, waves
from viewer.draw.paint_canvas import SIDE
from viewer.model.state import AppState
from viewer.panels import encoding_source
from viewer.panels.encoding import EncodingPanel

VERMILION = (0xD5, 0x5E, 0x00)


@pytest.fixture(autouse=True)
def _no_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """The built-in picture takes half a second of a core, in a thread."""
    monkeypatch.setattr(encoding_source, "sample_photo", lambda side: np.full((side, side, 3), 0.5))


def with_study(state: str, name: str = "image") -> AppState:
    return make_state(replace(make_snapshot(), study=make_study(state, name)))  # pyright: ignore[reportArgumentType]


def opened(screen: Screen) -> EncodingPanel:
    screen.size = (900.0, 400.0)
    return EncodingPanel()


def test_what_is_painted_is_learnt(screen: Screen) -> None:
    panel, state = opened(screen), make_state(make_snapshot())
    screen.click(panel, state, "encoding.view.draw")
    assert screen.click(panel, state, "encoding.learn_drawing") == []  # an empty canvas
    screen.click(panel, state, "encoding.color.d55e00")
    left, top, right, bottom = screen.widgets["encoding.canvas"]

    def at(column: float, row: float) -> tuple[float, float]:
        return left + (right - left) * column / SIDE, top + (bottom - top) * row / SIDE

    canvas = panel._source.canvas
    white = canvas.pixels
    screen.drag(panel, state, at(20, 30), at(100, 30), at(100, 90))
    painted = [(30, 20), (30, 60), (30, 99), (60, 99), (89, 99)]  # row, column: on both legs of the stroke
    assert all(tuple(canvas.pixels[where]) == VERMILION for where in painted)
    assert (canvas.pixels[[10, 60, 120], [60, 60, 99]] == 255).all()
    stroke = canvas.pixels
    screen.click(panel, state, "encoding.clear")
    np.testing.assert_array_equal(canvas.pixels, white)
    screen.click(panel, state, "encoding.undo")
    np.testing.assert_array_equal(canvas.pixels, stroke)
    (start,) = screen.click(panel, state, "encoding.learn_drawing")
    assert isinstance(start, StartStudy)
    assert (start.name, start.options) == ("image", {"frequencies": "4", "sigma": "5"})
    assert start.photo is not None
    np.testing.assert_array_equal(np.asarray(Image.open(start.photo)), stroke)
    assert "encoding.canvas" not in screen.widgets  # the pictures that learn it are in its place


def test_a_photo_is_opened_by_its_path(screen: Screen, tmp_path: Path) -> None:
    panel, state = opened(screen), make_state(make_snapshot())
    photo = tmp_path / "a photo.png"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(photo)
    screen.click(panel, state, "encoding.view.draw")
    assert screen.click(panel, state, "encoding.learn_photo") == []  # no path yet
    screen.click(panel, state, "encoding.path")
    imgui.get_io().add_input_characters_utf8(str(photo))
    screen.frame(panel, state)
    (start,) = screen.click(panel, state, "encoding.learn_photo")
    assert isinstance(start, StartStudy)
    assert (start.name, start.photo) == ("image", photo)


def test_the_drawing_and_what_may_still_run_outlive_those_that_begin_again(screen: Screen) -> None:
    panel, state = opened(screen), make_state(make_snapshot())
    screen.click(panel, state, "encoding.view.draw")
    screen.click(panel, state, "encoding.stripes")
    (first,) = screen.click(panel, state, "encoding.learn_drawing")
    assert isinstance(first, StartStudy)
    begun, shown = [first], replace(make_study("running", "image"), folder=first.folder)
    state.snapshot = replace(state.snapshot, study=shown)
    for _ in range(3):  # the worker is late: it still shows the first
        begun += [a for a in screen.click(panel, state, "encoding.again") if isinstance(a, StartStudy)]
    assert len(begun) == 4
    assert all(one.folder.is_dir() and one.photo == first.photo for one in begun)
    assert first.photo is not None
    state.snapshot = replace(state.snapshot, study=replace(shown, folder=begun[-1].folder))
    screen.click(panel, state, "encoding.again")
    assert [one.folder.is_dir() for one in begun] == [False, False, False, True]
    assert first.photo.is_file()


def test_a_drawing_replaces_what_is_being_learnt_but_no_other_study(screen: Screen) -> None:
    panel, state = opened(screen), with_study("running")
    screen.click(panel, state, "encoding.view.draw")
    screen.click(panel, state, "encoding.checker")
    actions = screen.click(panel, state, "encoding.learn_drawing")
    assert [type(action) for action in actions] == [CancelStudy, StartStudy]
    panel, state = opened(screen), with_study("running", "memory")
    assert screen.click(panel, state, "encoding.start") == []


def test_a_stopped_study_goes_on_or_begins_again(screen: Screen) -> None:
    panel, state = opened(screen), make_state(make_snapshot())
    (start,) = screen.click(panel, state, "encoding.start")
    assert isinstance(start, StartStudy)
    state = with_study("running")
    assert screen.click(panel, state, "encoding.stop") == [CancelStudy()]
    state.snapshot = replace(state.snapshot, study=replace(make_study("cancelled", "image"), folder=start.folder))
    assert screen.click(panel, state, "encoding.go_on") == [start]
    (again,) = screen.click(panel, state, "encoding.again")
    assert isinstance(again, StartStudy)
    assert again.folder != start.folder
    assert again.options == {"frequencies": "6", "sigma": "10"}  # what was turned stays turned


def test_sliders_turn_the_running_study_while_they_are_dragged(screen: Screen) -> None:
    panel, state = opened(screen), with_study("running")
    screen.frame(panel, state)
    screen.frame(panel, state)
    for name, last in (("L", 12.0), ("σ", 64.0)):
        left, top, right, bottom = screen.widgets[f"encoding.{name}"]
        y = (top + bottom) / 2
        turned = screen.drag(panel, state, (left + 0.1 * (right - left), y), ((left + right) / 2, y), (right, y))
        assert {type(action) for action in turned} == {TurnKnob}
        assert len(turned) == 3  # one for each place of the mouse
        assert turned[-1] == TurnKnob(name, last)
    study = state.snapshot.study
    assert study is not None
    obeyed = tuple(knob._replace(value=knob.most) for knob in study.knobs)
    state.snapshot = replace(state.snapshot, study=replace(study, knobs=obeyed))
    screen.frame(panel, state)
    turned_in_the_lab = replace(study, knobs=tuple(knob._replace(value=3.0) for knob in study.knobs))
    state.snapshot = replace(state.snapshot, study=turned_in_the_lab)
    screen.frame(panel, state)
    assert panel._page.wanted() == {"L": 3.0, "σ": 3.0}


@pytest.mark.parametrize("ended", ["done", "cancelled"])
def test_a_slider_that_is_let_go_begins_an_ended_study_again(screen: Screen, ended: str) -> None:
    panel, state = opened(screen), with_study(ended)
    screen.frame(panel, state)
    screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["encoding.L"]
    y = (top + bottom) / 2
    (start,) = screen.drag(panel, state, ((left + right) / 2, y), (right, y))
    assert isinstance(start, StartStudy)
    assert start.options == {"frequencies": "12", "sigma": "10"}
    study = state.snapshot.study
    assert study is not None
    captions = {one.name: one.captions[-1] for one in panel._rows(screen, study, {})["pictures"]}
    assert captions["positional"] == "L = 6"  # what is shown was learnt with it
    begun = replace(study, state="running", folder=start.folder, knobs=(study.knobs[0]._replace(value=12.0),))
    state.snapshot = replace(state.snapshot, study=begun)
    screen.frame(panel, state)
    assert {one.name: one.captions[-1] for one in panel._rows(screen, begun, {})["pictures"]}["positional"] == "L = 12"
    begun_in_the_lab = replace(make_study("running", "image"), folder=start.folder / "other")
    state.snapshot = replace(state.snapshot, study=begun_in_the_lab)
    screen.frame(panel, state)
    assert panel._page.wanted() == {"L": 6.0, "σ": 10.0}


def test_the_numbers_are_those_that_networks_get() -> None:
    longest, count = 128, 12
    pixels = np.array([[0, 127], [37, 90], [64, 1]])
    p = place(pixels, longest)  # pyright: ignore[reportArgumentType]: an array
    own = waves(p, count)  # (P, 2, L, 2)
    points = torch.tensor(np.column_stack([p, np.zeros(3)]), dtype=torch.float32)
    theirs = encodings.frequency(points, count, include_input=False, pi=True).reshape(3, count, 2, 3)[..., :2]
    np.testing.assert_allclose(own, theirs.permute(0, 3, 1, 2).numpy(), atol=1e-3)
    config = ImageConfig(frequencies=count)  # the study's networks: the first pair has the other sign
    b = frequencies("positional", config, torch.empty(0, 2))
    learnt = encode(torch.tensor(pixels / longest, dtype=torch.float32), b).reshape(3, 2, 2, count)
    signs = np.where(np.arange(count) == 0, -1, 1)[:, None]
    np.testing.assert_allclose(own * signs, learnt.permute(0, 2, 3, 1).numpy(), atol=2e-3)
    assert equation(2) == "γ(p) = (sin 2⁰πp, cos 2⁰πp, sin 2¹πp, cos 2¹πp)"
    assert equation(12) == "γ(p) = (sin 2⁰πp, cos 2⁰πp, …, sin 2¹¹πp, cos 2¹¹πp)"
