"""The bench of a ray by hand: samples are dragged, added and deleted, and the terms follow."""

from __future__ import annotations

import numpy as np
import pytest
from imgui_bundle import imgui
from panel_screen import Screen
from panel_states import make_snapshot, make_state

from nerf_core.live.messages import Snapshot
from nerf_core.probe import hand_terms
from viewer.model.hand_bench import MOST, HandBench
from viewer.model.state import AppState
from viewer.panels.by_hand import ByHandPanel, _as_fine


@pytest.fixture
def state(screen: Screen) -> AppState:
    screen.size = (900.0, 400.0)
    return make_state(make_snapshot())


def middle(screen: Screen, name: str) -> tuple[float, float]:
    left, top, right, bottom = screen.widgets[name]
    return (left + right) / 2, (top + bottom) / 2


def test_a_dragged_sample_moves_and_the_pixel_follows(screen: Screen, state: AppState) -> None:
    panel = ByHandPanel()
    bench = panel.bench
    for _ in range(3):
        screen.frame(panel, state)
    before = bench.ray
    x, y = middle(screen, "hand.sample 1")
    left, top, _, bottom = screen.widgets["hand.densities"]
    aim = x + 15, top + 0.25 * (bottom - top)
    screen.drag(panel, state, (x, y), (x + 8, y - 10), aim)
    assert bench.chosen == 0
    assert bench.ray.t[0] > before.t[0]
    assert bench.ray.sigma[0] == pytest.approx(0.75 * 10, rel=0.02)  # the axis goes to 1.25 · 8
    assert hand_terms(bench.ray).weights[0] > hand_terms(before).weights[0]
    assert state.hand_changes == 1  # one drag is one change
    screen.drag(panel, state, aim, (screen.widgets["hand.densities"][2] - 150, aim[1]))
    assert bench.chosen == 2  # it passed two others and stays chosen
    assert (np.diff(bench.ray.t) >= 0).all()
    for _ in range(2):
        screen.click(panel, state, "hand.undo")
    np.testing.assert_array_equal(bench.ray.t, before.t)
    screen.drag(panel, state, (left + 3, top + 3), (left + 60, top + 30))  # where there is nothing
    assert not bench.can_undo


def test_the_end_of_the_ray_is_dragged(screen: Screen, state: AppState) -> None:
    panel = ByHandPanel()
    for _ in range(3):
        screen.frame(panel, state)
    x, y = middle(screen, "hand.far")
    screen.drag(panel, state, (x, y), (x - 5, y), (0, y))
    ray = panel.bench.ray
    assert ray.t[-1] < ray.far < ray.t[-1] + 0.01  # it stops at the last sample
    assert state.hand_changes == 1


def test_samples_are_added_and_deleted(screen: Screen, state: AppState) -> None:
    panel, io = ByHandPanel(), imgui.get_io()
    io.delta_time = 0.02
    for _ in range(3):
        screen.frame(panel, state)
    left, top, right, bottom = screen.widgets["hand.densities"]
    place = left + 0.85 * (right - left), top + 0.5 * (bottom - top)
    screen.drag(panel, state, place)
    screen.drag(panel, state, place)
    assert len(panel.bench.ray.t) == 6
    assert panel.bench.ray.sigma[panel.bench.chosen] == pytest.approx(5, rel=0.02)
    io.delta_time = 0.2
    while len(panel.bench.ray.t) < MOST - 1:
        panel.bench.add_in_widest()
    for _ in range(2):  # the second is one too many
        screen.click(panel, state, "hand.add")
    assert len(panel.bench.ray.t) == MOST
    while len(panel.bench.ray.t) > 1:
        panel.bench.delete(0)
    for _ in range(2):
        screen.click(panel, state, "hand.delete")
    assert not len(panel.bench.ray.t)
    np.testing.assert_array_equal(hand_terms(panel.bench.ray).pixel, panel.bench.ray.background)
    assert state.hand_changes == 1 + 1 + 1  # those of this panel's own frames


def test_the_opened_ray_is_taken_and_resampled(screen: Screen, state: AppState) -> None:
    panel = ByHandPanel()
    screen.click(panel, state, "hand.take")
    ray = state.snapshot.ray
    assert ray is not None
    np.testing.assert_allclose(hand_terms(panel.bench.ray).pixel, ray.color, atol=0.01)
    screen.click(panel, state, "hand.resample")
    assert "hand.count" in screen.widgets
    state.snapshot = Snapshot()
    screen.click(panel, state, "hand.take")  # no ray is open
    assert state.hand_changes == 1


def test_one_gesture_is_one_change() -> None:
    bench = HandBench()
    for sigma in (1.0, 2.0, 3.0):
        bench.move(0, 2.8, sigma, "drag")
    bench.end_gesture()
    bench.move(0, 2.8, 4.0, "drag")
    bench.undo()
    assert bench.ray.sigma[0] == 3.0
    bench.undo()
    assert bench.ray.sigma[0] == 1.5
    bench.undo()
    assert bench.changes == 4


def test_distances_are_written_so_that_their_difference_comes_out() -> None:
    assert [_as_fine(t, 0.0322) for t in (3.4421, 3.40991)] == ["3.4421", "3.4099"]
    assert [_as_fine(t, 0.6) for t in (4.5, 3.9)] == ["4.5", "3.9"]
    assert _as_fine(1234.0, 500.0) == "1234"
    assert _as_fine(10.0, 1.0) == "10"
