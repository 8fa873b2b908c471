"""The panel of the capture report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from panel_screen import Screen
from panel_states import make_report_state, make_snapshot, make_state

from nerf_core.captures.report_records import ReportState
from nerf_core.live.messages import CancelReport, Snapshot, StartReport, WriteReport
from viewer.model.state import AppState, GoToView
from viewer.ui.contract import PANELS, Panel


@pytest.fixture
def panel(screen: Screen) -> Panel:
    screen.size = (1100.0, 420.0)
    return PANELS.get("capture_report")()


def with_report(report: ReportState | None) -> AppState:
    return make_state(replace(make_snapshot(), report=report))


def test_a_check_is_asked_for_and_cancelled(screen: Screen, panel: Panel) -> None:
    assert screen.click(panel, with_report(None), "report.check") == [StartReport()]
    assert screen.click(panel, with_report(make_report_state("running")), "report.cancel") == [CancelReport()]
    assert "report.check" not in screen.widgets
    for state in ("cancelled", "failed"):
        assert screen.click(panel, with_report(make_report_state(state)), "report.check") == [StartReport()]


def test_without_a_scene_nothing_is_checked(screen: Screen, panel: Panel) -> None:
    screen.frame(panel, make_state(Snapshot()))
    assert screen.widgets == {}


def test_a_report_of_another_scene_is_not_shown(screen: Screen, panel: Panel) -> None:
    state = with_report(replace(make_report_state("done"), loaded=7))
    screen.frame(panel, state)
    assert "report.photo.0" not in screen.widgets
    assert "report.check" in screen.widgets


def test_photos_that_stand_out_come_first_and_a_click_looks_through_one(screen: Screen, panel: Panel) -> None:
    state = with_report(make_report_state("done"))
    assert screen.click(panel, state, "report.photo.3") == [GoToView(3)]
    tops = {name: place[1] for name, place in screen.widgets.items() if name.startswith("report.photo.")}
    assert sorted(tops, key=lambda name: tops[name])[:2] == ["report.photo.3", "report.photo.5"]


def test_a_click_on_a_column_sorts_by_it(screen: Screen, panel: Panel) -> None:
    state = with_report(make_report_state("done"))

    def first() -> str:
        screen.frame(panel, state)
        tops = {name: place[1] for name, place in screen.widgets.items() if name.startswith("report.photo.")}
        return min(tops, key=lambda name: tops[name])

    screen.click(panel, state, "report.sort.exposure")
    assert first() == "report.photo.23"  # the darkest
    screen.click(panel, state, "report.sort.exposure")
    assert first() == "report.photo.22"  # the brightest


def test_the_page_is_written_where_the_user_says(screen: Screen, panel: Panel) -> None:
    state = with_report(make_report_state("done"))
    assert screen.click(panel, state, "report.write") == [WriteReport(Path("spheres-report.html"))]
